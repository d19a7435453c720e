"""Results of one recipe over its training seeds: how far another training may lie from this one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ada_diffuser.rollout.result import Evaluation, Measure, by_session, mean_and_error, measures_as_json, plain_options

_SEED = re.compile(r"-seed(\d+)$")


@dataclass(frozen=True, eq=False)
class SeedGroup:
    """Evaluations of models that differ in their training seed alone, on the same episodes with the same settings."""

    #: The models' common name, without `-seedN`.
    recipe: str
    #: Two or more, each of another model.
    results: list[Evaluation]

    @property
    def mean_return(self) -> float:
        """Mean over training seeds and episodes."""
        return float(self._returns().mean())

    @property
    def standard_error(self) -> float:
        """Of the mean over sessions, these trainings given: each episode's return is first averaged over the training seeds."""
        return mean_and_error(np.split(self._returns().mean(axis=0), self._ends[:-1]))[1]

    @property
    def standard_error_training(self) -> float:
        """Of the mean over training seeds, these episodes given."""
        seeds = self._returns().mean(axis=1)
        return float(seeds.std(ddof=1) / np.sqrt(len(seeds)))

    @property
    def median_return(self) -> float:
        return float(np.median(self._returns()))

    @property
    def failures(self) -> int:
        return sum(result.failures for result in self.results)

    @property
    def measures(self) -> dict[str, Measure]:
        """Of the mean over training seeds of what the environment says of each episode; the errors are over sessions, as above."""
        found = {}
        for name in self.results[0].measures:
            values = np.mean([result.measures[name].values for result in self.results], axis=0)
            found[name] = Measure.of([part.tolist() for part in np.split(values, self._ends[:-1])])
        return found

    def as_json(self) -> dict[str, Any]:
        """An entry beside those of its models, told from them by `training_seeds`."""
        first = self.results[0].trial
        return {
            "env": first.env,
            **first.env_options_as_json(),
            "model": self.recipe,
            "training_seeds": [result.model.name for result in self.results],
            "seed": first.seed,
            "withhold_rewards": first.withhold_rewards,
            "options": plain_options(first.options.given()),
            "mean_returns": [round(result.mean_return, 6) for result in self.results],
            "mean_return": round(self.mean_return, 6),
            "standard_error": round(self.standard_error, 6),
            "standard_error_training_seeds": round(self.standard_error_training, 6),
            "median_return": round(self.median_return, 6),
            "failures": self.failures,
            **measures_as_json(self.measures),
        }

    @property
    def _ends(self) -> np.ndarray:
        """Episodes before the end of each session."""
        return np.cumsum([len(session) for session in by_session(self.results[0].episodes)])

    def _returns(self) -> np.ndarray:
        """`(training seeds, episodes)`."""
        return np.stack([result.returns for result in self.results])


def training_seed(model: str) -> int | None:
    """N of a model's name `...-seedN`; None of another name."""
    found = _SEED.search(model)
    return int(found[1]) if found else None


def by_recipe(results: Sequence[Evaluation]) -> list[SeedGroup]:
    """Groups of `NAME-seed0`, `NAME-seed1`, ... with equal settings, in the order of `results`; one model alone is no group."""
    groups: dict[Any, dict[str, Evaluation]] = {}
    for result in results:
        name, seeds = _SEED.subn("", result.model.name)
        if seeds:
            trial = result.trial
            key = (name, replace(trial, model="", vector=1))
            groups.setdefault(key, {})[result.model.name] = result
    return [SeedGroup(key[0], list(group.values())) for key, group in groups.items() if len(group) > 1]
