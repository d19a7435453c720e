"""Data of a learner: its policy half way, all that it tried on the way there, or both it and the best, as D4RL's data sets have them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .ars import both_ways, perturbations, start
from .policy import Expert, LinearPolicy, PolicyBank
from .training import ExpertRecipe, search_rngs

QUALITIES = ("medium", "medium-replay", "medium-expert")
MEDIUM = 1 / 3
"""Share of the best return that the medium policy earns, about: D4RL's do."""


@dataclass(frozen=True)
class Flight:
    """Who flies an episode.

    Attributes:
        expert: flies it.
        seed: of the environment; None: as without flights.
        noise: standard deviation of the action noise; None: as without flights.
    """

    expert: Expert
    seed: int | None = None
    noise: float | None = None


def flights(bank: PolicyBank, recipe: ExpertRecipe, quality: str, episodes: int, seed: int) -> tuple[list[Flight], dict[str, Any]]:
    """Who flies each episode of a data set of this quality, and what its card says of it.

    `medium`: of the policies that were judged before the best one, the one nearest to a third of its return. `medium-expert`: that one
    flies the first half, the best one the second. `medium-replay`: the perturbed policies that the run tried up to there, each in the
    episode that it was tried in, without noise: all of them, or `episodes` drawn by the seed, in the run's order. Raises `ValueError`
    where the expert has no run, or its best is the first that was judged.
    """
    if bank.run is None:
        raise ValueError("--quality needs an expert with its run: the one policy of a search that the class wants kept (`keeps_run`)")
    record = bank.card["policies"][0]
    best = record["iteration"], record["judged"]
    iteration, earned = _medium(record["run"], best)
    medium = PolicyBank([bank.run[iteration - 1]], bank.targets, {})
    card: dict[str, Any] = {"name": quality, "medium": {"iteration": iteration, "judged": earned}}
    if quality == "medium-replay":
        tried = _tried(bank.run[:iteration], recipe, record["search"])
        card["episodes_of_the_run"] = len(tried)
        kept = np.sort(np.random.default_rng([seed, 7]).permutation(len(tried))[:episodes])
        return [Flight(PolicyBank([tried[i][0]], bank.targets, {}), tried[i][1], 0.0) for i in kept], card
    experts = episodes // 2 if quality == "medium-expert" else 0
    if experts:
        card["expert"] = {"iteration": best[0], "judged": best[1]}
    return [Flight(medium)] * (episodes - experts) + [Flight(bank)] * experts, card


def _medium(judged: list[tuple[int, float]], best: tuple[int, float]) -> tuple[int, float]:
    before = [(iteration, earned) for iteration, earned in judged if iteration < best[0]]
    if not before:
        raise ValueError("the best policy of the run is the first that was judged, so there is none on the way to it: let it search longer")
    return min(before, key=lambda one: abs(one[1] - MEDIUM * best[1]))


def _tried(run: list[LinearPolicy], recipe: ExpertRecipe, search: int) -> list[tuple[LinearPolicy, int]]:
    """Each policy that these iterations tried, and the seed of its episode, in order."""
    rng, *_ = search_rngs(recipe.seed, 0, search)
    begun = [start(run[0].weights.shape), *run[:-1]]
    drawn = perturbations(run[0].weights.shape, recipe.ars, rng)
    return [
        (moved, int(seed))
        for policy, (deltas, seeds) in zip(begun, drawn, strict=False)
        for delta, seed in zip(deltas, seeds, strict=True)
        for moved in both_ways(policy, delta, recipe.ars)
    ]
