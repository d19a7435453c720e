"""Augmented Random Search, version V2-t (Mania, Guy, Recht 2018, Algorithm 2), for linear policies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from ..environments.search import ArsSettings
from .policy import LinearPolicy

STD_MIN = 1e-3


class RunningMoments:
    """Mean and standard deviation of all states visited so far (Chan's parallel update)."""

    def __init__(self, size: int) -> None:
        self.count = 0
        self.mean = np.zeros(size)
        self._squares = np.zeros(size)

    def add(self, states: np.ndarray) -> None:
        """Take in states (n, size)."""
        count, mean = len(states), states.mean(axis=0)
        delta, total = mean - self.mean, self.count + count
        self._squares += ((states - mean) ** 2).sum(axis=0) + delta**2 * self.count * count / total
        self.mean = self.mean + delta * count / total
        self.count = total

    @property
    def std(self) -> np.ndarray:
        """Standard deviation, ones before the first state, never below a thousandth."""
        if self.count == 0:
            return np.ones_like(self.mean)
        return np.maximum(np.sqrt(self._squares / self.count), STD_MIN)


Rollout = Callable[[LinearPolicy, int], tuple[float, np.ndarray]]
"""(policy, episode seed) -> (return, states visited (steps, features))."""


def perturbations(shape: tuple[int, int], settings: ArsSettings, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """What each iteration tries: perturbations (directions, *shape) and an episode seed for each (directions,)."""
    for _ in range(settings.iterations):
        yield rng.standard_normal((settings.directions, *shape)), rng.integers(2**31, size=settings.directions)


def both_ways(policy: LinearPolicy, delta: np.ndarray, settings: ArsSettings) -> tuple[LinearPolicy, LinearPolicy]:
    """The policy moved along a perturbation (actions, features), and against it."""
    step = settings.noise * delta
    return replace(policy, weights=policy.weights + step), replace(policy, weights=policy.weights - step)


def search(rollout: Rollout, shape: tuple[int, int], settings: ArsSettings, rng: np.random.Generator) -> Iterator[LinearPolicy]:
    """Yield the policy after each iteration.

    Both signs of a perturbation see the same episode seed, so their difference is due to the perturbation.

    Args:
        rollout: plays one episode.
        shape: (actions, features) of the policy.
        settings: the constants.
        rng: all randomness of the search.
    """
    policy, moments = start(shape), RunningMoments(shape[1])
    for deltas, seeds in perturbations(shape, settings, rng):
        returns, visited = np.empty((settings.directions, 2)), []
        for i, (delta, seed) in enumerate(zip(deltas, seeds, strict=True)):
            for j, moved in enumerate(both_ways(policy, delta, settings)):
                returns[i, j], states = rollout(moved, int(seed))
                visited.append(states)
        weights = policy.weights + ascent(deltas, returns, settings)
        moments.add(np.concatenate(visited))
        policy = LinearPolicy(weights, moments.mean, moments.std)
        yield policy


def start(shape: tuple[int, int]) -> LinearPolicy:
    """What a search begins with: it does nothing."""
    return LinearPolicy(np.zeros(shape), np.zeros(shape[1]), np.ones(shape[1]))


def ascent(deltas: np.ndarray, returns: np.ndarray, settings: ArsSettings) -> np.ndarray:
    """The update of the weights: the best `top` perturbations, each weighted by its gain, over the returns' spread."""
    best = np.argsort(-returns.max(axis=1), kind="stable")[: settings.top]
    gain = returns[best, 0] - returns[best, 1]
    spread = max(float(returns[best].std()), 1e-8)
    return settings.step / (settings.top * spread) * np.tensordot(gain, deltas[best], axes=1)
