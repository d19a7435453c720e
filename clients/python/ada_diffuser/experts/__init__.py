"""Experts that see the hidden context, made on the spot: analytic for the point mass, ARS for the cheetah."""

from .policy import (
    AnalyticPilot,
    CalledExpert,
    Expert,
    LinearPolicy,
    PolicyBank,
    import_expert,
    load_expert,
    random_expert,
    save_expert,
)
from .training import ExpertRecipe, make_expert, recipe_for

__all__ = [
    "AnalyticPilot",
    "CalledExpert",
    "Expert",
    "ExpertRecipe",
    "LinearPolicy",
    "PolicyBank",
    "import_expert",
    "load_expert",
    "make_expert",
    "random_expert",
    "recipe_for",
    "save_expert",
]
