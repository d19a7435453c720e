"""What an expert is: a function of the observation and the true context; and its file."""

from __future__ import annotations

import importlib
import json
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np


class Expert(Protocol):
    """Anything that flies an environment with its context in sight."""

    card: dict[str, Any]

    def sizes(self, context_size: int) -> tuple[int, int] | None:
        """(observation size, action size) it is made for, in an environment with that context size (0: it tells none); None: any."""
        ...

    def begin(self, rng: np.random.Generator) -> None:
        """An episode begins. What an expert draws it draws from `rng`; one without a memory draws nothing."""
        ...

    def act(self, observation: np.ndarray, context: np.ndarray | None) -> np.ndarray:
        """Action for an observation and the context of the coming step, not clipped. Where the environment tells no context it is the goal,
        and None where there is none either.
        """
        ...


@dataclass
class CalledExpert:
    """A function of the observation and the context: an environment's own formula, or somebody's.

    Attributes:
        function: called as `function(observation, context)`; the context is None where the environment tells none.
        card: where it comes from.
    """

    function: Callable[[np.ndarray, np.ndarray | None], Any]
    card: dict[str, Any]

    def sizes(self, context_size: int) -> None:
        """See `Expert.sizes`."""
        return None

    def begin(self, rng: np.random.Generator) -> None:
        """See `Expert.begin`."""

    def act(self, observation: np.ndarray, context: np.ndarray | None) -> np.ndarray:
        """See `Expert.act`."""
        return np.asarray(self.function(observation, context), np.float64)


@dataclass
class PlannedExpert:
    """An expert that remembers where it stands in an episode.

    Attributes:
        plan: makes, from a generator, the function of observation and context that flies one episode, called once a step.
        card: where it comes from.
    """

    plan: Callable[[np.random.Generator], Callable[[np.ndarray, np.ndarray | None], Any]]
    card: dict[str, Any]

    def sizes(self, context_size: int) -> None:
        """See `Expert.sizes`."""
        return None

    def begin(self, rng: np.random.Generator) -> None:
        """See `Expert.begin`."""
        self._function = self.plan(rng)

    def act(self, observation: np.ndarray, context: np.ndarray | None) -> np.ndarray:
        """See `Expert.act`."""
        return np.asarray(self._function(observation, context), np.float64)


def import_expert(name: str) -> CalledExpert:
    """`MODULE:FUNCTION` as an expert. Raises `ValueError` with the reason why it is none."""
    module, _, function = name.partition(":")
    try:
        found = getattr(importlib.import_module(module), function)
    except Exception as error:  # a module of the caller's: it may fail in any way
        raise ValueError(f"--expert {name}: {type(error).__name__}: {error}") from error
    if not callable(found):
        raise ValueError(f"--expert {name} is no function of an observation and a context")
    return CalledExpert(found, {"kind": "function", "name": name})


def random_expert(low: np.ndarray, high: np.ndarray, seed: int) -> CalledExpert:
    """Uniform actions between bounds (actions,). Raises `ValueError` for infinite ones."""
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError("--expert random draws between the bounds of the actions, and this environment has none")
    rng = np.random.default_rng([seed, 3])
    return CalledExpert(lambda observation, context: rng.uniform(low, high), {"kind": "random"})


@dataclass(frozen=True)
class LinearPolicy:
    """`a = W ((x - mean) / std)` over `x`, the observation with or without the context behind it.

    Attributes:
        weights: W, shape (actions, features).
        mean: running mean of `x` in training, shape (features,).
        std: its standard deviation, shape (features,).
    """

    weights: np.ndarray
    mean: np.ndarray
    std: np.ndarray

    def act(self, features: np.ndarray) -> np.ndarray:
        """Action (actions,) for features (features,)."""
        return self.weights @ ((features - self.mean) / self.std)


@dataclass
class PolicyBank:
    """One linear policy that takes the context as an input, or several, of which the nearest to the context acts.

    Attributes:
        policies: at least one.
        targets: the context each was trained for, shape (policies,); None where the one policy reads the context.
        card: how they were made and what they reach.
        run: of the search for the one policy, the policy after each iteration; None where it was not kept.
    """

    policies: list[LinearPolicy]
    targets: np.ndarray | None
    card: dict[str, Any]
    run: list[LinearPolicy] | None = None

    def sizes(self, context_size: int) -> tuple[int, int]:
        """See `Expert.sizes`."""
        actions, features = self.policies[0].weights.shape
        return features - (context_size if self.targets is None else 0), actions

    def begin(self, rng: np.random.Generator) -> None:
        """See `Expert.begin`."""

    def act(self, observation: np.ndarray, context: np.ndarray | None) -> np.ndarray:
        """See `Expert.act`."""
        if context is None and len(self.policies) == 1:
            return self.policies[0].act(observation)
        if context is None:
            raise ValueError("the expert chooses among its policies by a hidden context, and this environment tells none")
        if self.targets is None:
            return self.policies[0].act(np.concatenate([observation, context]))
        return self.policies[int(np.argmin(np.abs(self.targets - context[0])))].act(observation)


def save_expert(expert: PolicyBank, path: Path) -> None:
    """Write the policies and their card to one `.npz`; the same bytes for the same expert."""
    arrays = {**_stacked(expert.policies), "card": np.array(json.dumps(expert.card, sort_keys=True))}
    if expert.targets is not None:
        arrays["targets"] = expert.targets
    if expert.run is not None:
        arrays |= {f"run_{name}": array for name, array in _stacked(expert.run).items()}
    partial = path.with_name(f".{path.name}.partial.npz")
    np.savez(partial, **arrays)
    os.replace(partial, path)


def load_expert(path: Path) -> PolicyBank:
    """Read what `save_expert` wrote. Raises `ValueError` naming the file if it is not an expert."""
    try:
        with np.load(path, allow_pickle=False) as file:
            run = _unstacked(file, "run_") if "run_weights" in file else None
            return PolicyBank(_unstacked(file), file.get("targets"), json.loads(str(file["card"])), run)
    except (KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not an expert written by ada-collect: {error}") from error


def _stacked(policies: list[LinearPolicy]) -> dict[str, np.ndarray]:
    return {name: np.stack([getattr(policy, name) for policy in policies]) for name in _ARRAYS}


def _unstacked(file: Any, prefix: str = "") -> list[LinearPolicy]:
    return [LinearPolicy(*arrays) for arrays in zip(*(file[prefix + name] for name in _ARRAYS), strict=True)]


_ARRAYS = ("weights", "mean", "std")
"""Of a `LinearPolicy`, in the order of its fields."""
