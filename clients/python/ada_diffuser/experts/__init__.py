"""Experts that see the hidden context, made on the spot: the environment's own formula, or a search as it wants one."""

from .kept import kept_expert
from .policy import (
    CalledExpert,
    Expert,
    LinearPolicy,
    PlannedExpert,
    PolicyBank,
    import_expert,
    load_expert,
    random_expert,
    save_expert,
)
from .snapshots import QUALITIES, Flight, flights
from .training import ExpertRecipe, formula_of, make_expert, recipe_for

__all__ = [
    "QUALITIES",
    "CalledExpert",
    "Expert",
    "ExpertRecipe",
    "Flight",
    "LinearPolicy",
    "PlannedExpert",
    "PolicyBank",
    "flights",
    "formula_of",
    "import_expert",
    "kept_expert",
    "load_expert",
    "make_expert",
    "random_expert",
    "recipe_for",
    "save_expert",
]
