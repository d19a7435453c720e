"""Experts that see the hidden context, made on the spot: analytic for the point mass, ARS for the cheetah."""

from .policy import AnalyticPilot, Expert, LinearPolicy, PolicyBank, load_expert, save_expert
from .training import ExpertRecipe, make_expert, recipe_for

__all__ = [
    "AnalyticPilot",
    "Expert",
    "ExpertRecipe",
    "LinearPolicy",
    "PolicyBank",
    "load_expert",
    "make_expert",
    "recipe_for",
    "save_expert",
]
