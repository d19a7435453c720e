"""What an environment of this package says of itself, beside Gymnasium's own methods; a subclass registers itself."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

NAMES: dict[str, str] = {}
"""Short name for command lines -> Gymnasium id."""


class HiddenTask(gym.Env[np.ndarray, np.ndarray]):
    """An environment whose dynamics or goal depend on a context that the observation does not show.

    `class Mine(HiddenTask, name="mine", id="ada/Mine-v0")` is all that a new one needs to be known to Gymnasium and to the
    commands; `name` and `id` are left out where a class is only there to be inherited from.
    """

    episode_steps: ClassVar[int] = 200
    """Steps after which an episode is truncated."""

    action_noise: ClassVar[tuple[float, ...]] = (0.0, 0.05, 0.1)
    """Standard deviations of the action noise under which `ada-collect` flies, where it is told no other; more of it stops the
    cheetah's gait."""

    def __init_subclass__(cls, *, name: str = "", id: str = "", **rest: Any) -> None:
        super().__init_subclass__(**rest)
        if name:
            NAMES[name] = id
            gym.register(id, entry_point=f"{cls.__module__}:{cls.__qualname__}", max_episode_steps=cls.episode_steps)

    @property
    def context(self) -> np.ndarray:
        """The hidden value that acts on the coming step, a vector."""
        raise NotImplementedError

    @property
    def search_targets(self) -> tuple[float, ...] | None:
        """Contexts that get an expert of their own in a search; empty: one expert reads the context; None: it is a formula."""
        return ()

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode counts as failed."""
        raise NotImplementedError
