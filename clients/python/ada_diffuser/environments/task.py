"""What an environment of this package says of itself, beside Gymnasium's own methods; a subclass registers itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from .search import Search

NAMES: dict[str, str] = {}
"""Short name for command lines -> Gymnasium id."""


@dataclass(frozen=True)
class References:
    """A scale of returns, as D4RL has one for each of its environments: https://github.com/Farama-Foundation/D4RL, `d4rl/infos.py`.

    Attributes:
        random: return of random actions, which is 0.
        expert: return of an expert, which is 100.
    """

    random: float
    expert: float

    def score(self, episode_return: float) -> float:
        """`100 (R - random) / (expert - random)`: linear, so that the mean of scores is the score of the mean."""
        return 100.0 * (episode_return - self.random) / (self.expert - self.random)


class Task(gym.Env[np.ndarray, np.ndarray]):
    """An environment of this package: all that the commands ask of it is said by its class.

    `class Mine(Task, name="mine", id="ada/Mine-v0")` is all that a new one needs to be known to Gymnasium and to the
    commands; `name` and `id` are left out where a class is only there to be inherited from. Nothing else knows an environment:
    its expert, noise, failures and length are asked of the class, and a film is drawn where it has Gymnasium's `render` and
    says `rgb_array` in its `metadata`. docs/simulator.md writes one. Where something is hidden it is a `HiddenTask`.
    """

    episode_steps: ClassVar[int] = 200
    """Steps after which an episode is truncated."""

    action_noise: ClassVar[tuple[float, ...]] = (0.0, 0.05, 0.1)
    """Standard deviations of the action noise, in units of the action, under which `ada-collect` flies where it is told no other:
    data should show states off the expert's path, and the way back."""

    expert_action: ClassVar[Callable[..., np.ndarray] | None] = None
    """The expert, where it is a formula: a method `expert_action(self, observation, context)` that answers an action, clipped or
    not; where nothing is hidden and there is a `goal` it is told that in the place of the context, and None where there is neither. It
    may use the environment's options, but nothing of the running episode. Its docstring's first line is the law on the data card."""

    expert_plan: ClassVar[Callable[..., Any] | None] = None
    """The expert, where it remembers what it did: a method `expert_plan(self, rng)` that answers, for one episode, a function of
    observation and context as `expert_action` is one. All that it draws it draws from `rng`. Its docstring's first line is on the card."""

    search: ClassVar[Search | None] = Search()
    """How the expert is searched for, where there is no formula."""

    references: ClassVar[References | None] = None
    """Returns that are 0 and 100 on a scale that others use too; None: there is no such scale."""

    goal_columns: ClassVar[tuple[int, ...]] = ()
    """Columns of the observation that a `goal` is about."""

    def __init_subclass__(cls, *, name: str = "", id: str = "", **rest: Any) -> None:
        super().__init_subclass__(**rest)
        if name:
            NAMES[name] = id
            gym.register(id, entry_point=f"{cls.__module__}:{cls.__qualname__}", max_episode_steps=cls.episode_steps)

    @property
    def goal(self) -> np.ndarray | None:
        """What the running episode wants of the columns `goal_columns`, in their order and units; None: nothing that could be told.

        A model that is told goals is told this one when the episode begins.
        """
        return None

    draw_ways: ClassVar[Callable[..., None] | None] = None
    """Where a picture of where episodes went says more than one of their numbers: a method `draw_ways(self, axes, ways, colour)` that
    draws them on matplotlib's axes, each of the `ways` the states (steps, state) of an episode and its goal, or None."""

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode counts as failed."""
        return False

    def measures(self, episode_return: float) -> dict[str, float]:
        """What is said of a finished episode beside its return, each number by its name: always the same names.

        Their means stand beside the return wherever that is told. Here it is the `score`, where there are `references`.
        """
        return {} if self.references is None else {"score": self.references.score(episode_return)}


class HiddenTask(Task):
    """A task whose dynamics or goal depend on a context that the observation does not show."""

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


def checked_range(option: str, values: Sequence[float]) -> tuple[float, float]:
    """The option of a constructor that says between which two numbers a context is drawn. Raises `ValueError` naming it."""
    if len(values) != 2 or not 0 < values[0] <= values[1] < math.inf:
        raise ValueError(f"{option} must be two numbers, 0 < least <= largest, not {values!r}")
    return float(values[0]), float(values[1])
