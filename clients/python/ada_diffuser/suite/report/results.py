"""Finished cells of a suite, and the statistics of a method over its training seeds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ada_diffuser.suite.cell import Cell, Places, cells, found
from ada_diffuser.suite.suite import MODES, Method, Mode, Suite


@dataclass(frozen=True)
class Estimate:
    """A mean and its standard errors; None where one number says nothing of the spread."""

    mean: float
    #: Over training seeds, these episodes given: what another training would change.
    over_seeds: float | None
    #: Over episodes, these trainings given: what other episodes would change.
    over_episodes: float | None = None

    @property
    def in_errors(self) -> float:
        """The mean over its standard error, both kinds pooled: the root of the sum of their squares. 0 where there is none; infinite where
        nothing spreads, as where every episode earns the same."""
        if self.mean == 0.0 or (self.over_seeds is None and self.over_episodes is None):
            return 0.0
        error = float(np.hypot(self.over_seeds or 0.0, self.over_episodes or 0.0))
        return self.mean / error if error else math.copysign(math.inf, self.mean)

    @classmethod
    def over(cls, values: NDArray[np.float64]) -> Estimate:
        """Of one number an episode, `(training seeds, episodes)`."""
        return cls(float(values.mean()), _error(values.mean(axis=1)), _error(values.mean(axis=0)))

    @classmethod
    def of(cls, values: Sequence[float]) -> Estimate:
        """Of one number a training seed."""
        return cls(float(np.mean(values)), _error(np.array(values)))


@dataclass(frozen=True, eq=False)
class Group:
    """A method in an environment in one mode: the files of its training seeds, in order."""

    files: list[dict[str, Any]]

    @cached_property
    def returns(self) -> NDArray[np.float64]:
        """`(training seeds, episodes)`; the same episodes for all."""
        return np.array([file["returns"] for file in self.files])

    @property
    def estimate(self) -> Estimate:
        """Of the return; each episode's is first averaged over the training seeds."""
        return Estimate.over(self.returns)

    @property
    def measures(self) -> dict[str, Estimate]:
        """Of what the environment says of its episodes beside their returns, by name; empty where it says nothing."""
        names = self.files[0].get("measures", {})
        return {name: Estimate.over(np.array([file["measures"][name] for file in self.files])) for name in names}

    @property
    def median(self) -> float:
        return float(np.median(self.returns))

    @property
    def failures(self) -> int:
        return sum(file["failures"] for file in self.files)

    def less(self, other: Group) -> Estimate | None:
        """How much more this one earns, on the same episodes, seed by training seed; None where they have no seed in common."""
        mine, theirs = self._by_seed(), other._by_seed()
        gaps = np.array([mine[seed] - theirs[seed] for seed in mine if seed in theirs])
        return Estimate.over(gaps) if len(gaps) else None

    def worse_than(self, other: Group) -> tuple[int, int]:
        """In how many episodes it earned less, and of how many, of the training seeds that both have: what one episode that flies off says
        nothing about.
        """
        mine, theirs = self._by_seed(), other._by_seed()
        worse = np.array([mine[seed] < theirs[seed] for seed in mine if seed in theirs])
        return int(worse.sum()), worse.size

    def _by_seed(self) -> dict[int, NDArray[np.float64]]:
        return {file["seed"]: row for file, row in zip(self.files, self.returns, strict=True)}

    def each(self, number: Callable[[dict[str, Any]], float | None]) -> Estimate | None:
        """Of one number of each file, where there are any."""
        values = [value for file in self.files if (value := number(file)) is not None]
        return Estimate.of(values) if values else None


@dataclass(frozen=True, eq=False)
class Results:
    """What there is of a suite."""

    suite: Suite
    groups: dict[tuple[str, str, Mode], Group]
    #: Files that there should be, and are.
    wanted: int
    there: int
    #: Of those that are there: measured before the suite, a recipe or the data became what they are.
    stale: int

    @classmethod
    def load(cls, suite: Suite, folder: Path) -> Results:
        """Whatever is finished; what was measured on other episodes than the suite's is not."""
        groups: dict[tuple[str, str, Mode], Group] = {}
        pairs = [(cell, mode) for cell in cells(suite) for mode in cell.method.modes]
        stale = 0
        for cell, mode in pairs:
            file = found(cell.file(Places(folder), mode))
            if file and (file["episodes"], file["first_seed"]) == (suite.episodes, suite.first_seed):
                groups.setdefault((cell.environment.name, cell.method.name, mode), Group([])).files.append(file)
                stale += _is_stale(file, cell, mode)
        return cls(suite, groups, len(pairs), sum(len(group.files) for group in groups.values()), stale)

    def group(self, environment: str, method: str, mode: Mode) -> Group | None:
        return self.groups.get((environment, method, mode))

    def any_mode(self, environment: str, method: str) -> Group | None:
        """Streaming where there is that, for what has to be shown once."""
        return self.group(environment, method, "streaming") or self.group(environment, method, "cold")

    @property
    def modes(self) -> list[Mode]:
        return [mode for mode in MODES if any(key[2] == mode for key in self.groups)]

    @property
    def environments(self) -> list[str]:
        """Those with something to show."""
        return [name for name in self.suite.environments if any(key[0] == name for key in self.groups)]

    @property
    def methods(self) -> list[Method]:
        return list(self.suite.methods.values())

    @property
    def files(self) -> list[dict[str, Any]]:
        return [file for group in self.groups.values() for file in group.files]


def own_error(file: dict[str, Any]) -> float | None:
    """What a linear readout of the latents is off by on the agent's own episodes, all steps."""
    return file["readout"] and file["readout"]["ages"][0]["mse"]


def probe_error(file: dict[str, Any], name: str = "mse") -> float | None:
    """What a linear probe is off by on held-out data, told all that the latent looks at; or the ceiling beside it."""
    rows = [row for row in file["probe"] or [] if row["evidence"] == "filter" and row["mse"] is not None]
    return rows[-1][name] if rows else None


def _is_stale(file: dict[str, Any], cell: Cell, mode: Mode) -> bool:
    """Where recipe and data are at hand; elsewhere nobody can tell."""
    try:
        return bool(file["key"] != cell.key(mode))
    except ValueError:
        return False


def _error(values: NDArray[np.float64]) -> float | None:
    """Standard error of the mean."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None
