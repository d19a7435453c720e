"""What an environment of this package says of itself, beside Gymnasium's own methods; a subclass registers itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from .search import Search

NAMES: dict[str, str] = {}
"""Short name for command lines -> Gymnasium id."""


class HiddenTask(gym.Env[np.ndarray, np.ndarray]):
    """An environment whose dynamics or goal depend on a context that the observation does not show.

    `class Mine(HiddenTask, name="mine", id="ada/Mine-v0")` is all that a new one needs to be known to Gymnasium and to the
    commands; `name` and `id` are left out where a class is only there to be inherited from. Nothing else knows an environment:
    its expert, noise, failures and length are asked of the class, and a film is drawn where it has Gymnasium's `render` and
    says `rgb_array` in its `metadata`. docs/simulator.md writes one.
    """

    episode_steps: ClassVar[int] = 200
    """Steps after which an episode is truncated."""

    action_noise: ClassVar[tuple[float, ...]] = (0.0, 0.05, 0.1)
    """Standard deviations of the action noise, in units of the action, under which `ada-collect` flies where it is told no other:
    data should show states off the expert's path, and the way back."""

    expert_action: ClassVar[Callable[..., np.ndarray] | None] = None
    """The expert, where it is a formula: a method `expert_action(self, observation, context)` that answers an action, clipped or
    not. It may use the environment's options, but nothing of the running episode. Its docstring's first line is the law on the
    data card."""

    search: ClassVar[Search | None] = Search()
    """How the expert is searched for, where there is no formula."""

    def __init_subclass__(cls, *, name: str = "", id: str = "", **rest: Any) -> None:
        super().__init_subclass__(**rest)
        if name:
            NAMES[name] = id
            gym.register(id, entry_point=f"{cls.__module__}:{cls.__qualname__}", max_episode_steps=cls.episode_steps)

    @property
    def context(self) -> np.ndarray:
        """The hidden value that acts on the coming step, a vector."""
        raise NotImplementedError

    def coming_context(self, steps: int) -> np.ndarray | None:
        """The contexts of the coming steps, `(steps, dim)`, the first of them that of now; None: what comes cannot be told.

        An oracle that knows the future is told them. To ask changes nothing: what is drawn later is drawn as if nobody had.
        """
        return None

    @property
    def mean_context(self) -> np.ndarray | None:
        """What a blind expert that is a formula takes the context for, in every episode; None: there is no blind expert."""
        return None

    @property
    def search_targets(self) -> tuple[float, ...]:
        """Contexts that get a policy of their own in a search, with `Search.holds`; empty: one policy reads the context."""
        return ()

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode counts as failed."""
        return False


def checked_range(option: str, values: Sequence[float]) -> tuple[float, float]:
    """The option of a constructor that says between which two numbers a context is drawn. Raises `ValueError` naming it."""
    if len(values) != 2 or not 0 < values[0] <= values[1] < math.inf:
        raise ValueError(f"{option} must be two numbers, 0 < least <= largest, not {values!r}")
    return float(values[0]), float(values[1])
