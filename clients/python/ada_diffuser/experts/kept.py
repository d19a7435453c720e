"""An expert's file, used again by whoever wants the same recipe."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

from .policy import PolicyBank, load_expert, save_expert
from .training import ExpertRecipe, make_expert


def kept_expert(recipe: ExpertRecipe, path: Path, search: Callable[[ExpertRecipe], PolicyBank] = make_expert) -> PolicyBank:
    """The expert of a file, where its recipe is this one; else a new one, which is written to it."""
    if path.exists():
        expert = load_expert(path)
        if expert.card.get("recipe") == json.loads(json.dumps(recipe.to_json())):
            return expert
        print(f"{path} has another recipe; training anew", file=sys.stderr)
    expert = search(recipe)
    save_expert(expert, path)
    return expert
