"""One method in one environment with one training seed: what it is made of, where its files are, and whether they are of today's suite."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ada_diffuser.dataset import card_path, sha256
from ada_diffuser.suite.suite import Environment, Method, Mode, Suite, is_trained
from ada_diffuser.suite.toml import loads


@dataclass(frozen=True)
class Places:
    """Where files go."""

    #: Finished cells, small and kept.
    cells: Path = Path("report/cells")
    #: Trainings, logs, and what is served.
    runs: Path = Path("runs/suite")
    #: Data sets that a suite collects.
    data: Path = Path("data")

    @property
    def stages(self) -> Path:
        """First stages of trainings, which planners share that look for the same context."""
        return self.runs / "stages"


@dataclass(frozen=True)
class Cell:
    """A piece of work. Its key and that of its training change with whatever would change its numbers, and with nothing else."""

    suite: Suite
    environment: Environment
    method: Method
    seed: int

    @property
    def name(self) -> str:
        return f"{self.environment.name}/{self.method.name}/seed{self.seed}"

    @property
    def recipe(self) -> Path:
        return self.method.recipes[self.environment.name]

    @property
    def keys(self) -> list[str]:
        """`KEY=VALUE`: what is set in the recipe, the environment's before the method's."""
        return [*self.environment.keys, *self.method.keys]

    @property
    def training_keys(self) -> list[str]:
        """Those that the training depends on."""
        return [key for key in self.keys if is_trained(key)]

    @property
    def default_keys(self) -> list[str]:
        """The others, which change the defaults of the finished checkpoint."""
        return [key for key in self.keys if not is_trained(key)]

    def file(self, places: Places, mode: Mode) -> Path:
        """What it found in this mode."""
        return places.cells / self.suite.name / self.environment.name / self.method.name / f"seed{self.seed}-{mode}.json"

    def log(self, places: Places) -> Path:
        return places.runs / self.suite.name / f"{self.name}.log"

    def training(self, places: Places) -> Path:
        """The folder of its training, which other cells, of other suites too, may share."""
        stems = "-".join(path.stem for path in (self.recipe, *self.method.changes))
        folder = f"{self.environment.name}-{stems}-{self._training_key}-seed{self.seed}"
        return places.runs / "trainings" / folder

    def data(self, places: Places) -> Path:
        """The data set, under a name that says how it is made where it is collected."""
        return self.environment.data or places.data / f"{self.environment.name}-{_digest(self._collected)}.h5"

    def missing(self, places: Places) -> list[Mode]:
        """The modes in which nothing was found yet, or something else was asked for when it was."""
        return [mode for mode in self.method.modes if (found(self.file(places, mode)) or {}).get("key") != self.key(mode)]

    def key(self, mode: Mode) -> str:
        """Of what it finds in this mode."""
        return _digest(
            {
                "training": self._training_key,
                "defaults": self.default_keys,
                "world": self._world,
                "mode": mode,
                "episodes": self.suite.episodes,
                "first_seed": self.suite.first_seed,
            }
        )

    @cached_property
    def _training_key(self) -> str:
        """ValueError where the recipe, or a data set that is not collected, cannot be read."""
        recipe = self._read("recipe", self.recipe)
        changes = [self._read("with", path) for path in self.method.changes]
        told = {name: value for name, value in recipe.items() if name not in ("name", "data", "seed")}
        data = self._collected if self.environment.data is None else _known_digest(self.environment)
        changed = {"with": changes} if changes else {}
        return _digest({"recipe": told, **changed, "set": self.training_keys, "seed": self.seed, "data": data})

    def _read(self, key: str, path: Path) -> dict[str, Any]:
        try:
            return loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise ValueError(f"methods.{self.method.name}.{key}: {path}: {error}") from None

    @property
    def _world(self) -> dict[str, Any]:
        one = self.environment
        return {"env": one.env, "options": dict(one.options), "episode_steps": one.episode_steps}

    @property
    def _collected(self) -> dict[str, Any]:
        return {"world": self._world, "collect": self.environment.collect}


def cells(suite: Suite) -> list[Cell]:
    """All of a suite, seed by seed, so that a suite that is stopped early has something of everything."""
    return [
        Cell(suite, environment, method, seed)
        for seed in suite.seeds
        for environment in suite.environments.values()
        for method in suite.methods.values()
        if environment.name in method.recipes
    ]


def found(path: Path) -> dict[str, Any] | None:
    """What a finished cell's file holds; None where there is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError):
        return None


def _known_digest(environment: Environment) -> str:
    """Of a data set that is there already, from its card where it has one."""
    path = environment.data
    assert path is not None
    if not path.exists():
        raise ValueError(f"environments.{environment.name}.data: there is no {path}; say how it is made (collect), or put it there")
    card = found(card_path(path)) or {}
    return card.get("file", {}).get("sha256") or sha256(path)


def _digest(value: Mapping[str, Any]) -> str:
    """Of a value as JSON, in 16 characters; the order of keys is no difference."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]
