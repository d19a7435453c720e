"""The cheetah under a wanted speed that changes within the episode and is rewarded later: once, or over a while."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .cheetah import CheetahTask
from .search import Search

TARGETS = (1.0, 2.5)
"""Wanted speeds, m/s."""
CHANGE = 0.02
"""Probability of another wanted speed, a step."""


class CheetahGoal(CheetahTask):
    """What the two share: the wanted speed `c_t`, and a reward of squares alone, as the paper has it.

    `c_0` is one of the targets, and in each step another takes its place with probability `change`. Steps before the first have `c_0`.
    """

    search = Search(holds="targets")

    def __init__(self, targets: Sequence[float], change: float, render_mode: str | None) -> None:
        if isinstance(targets, str) or not targets or not all(0.0 < speed < np.inf for speed in targets):
            raise ValueError(f"targets must be at least one speed above 0, not {targets!r}")
        if not 0.0 <= change <= 1.0:
            raise ValueError(f"change must be a probability, not {change!r}")
        super().__init__(render_mode=render_mode)
        self.targets, self.change = tuple(float(speed) for speed in targets), float(change)
        self._wanted = [self.targets[0]]
        self._still = 0.0
        """What standing still would have earned so far."""

    @property
    def search_targets(self) -> tuple[float, ...]:
        """One policy a speed."""
        return tuple(sorted(set(self.targets)))

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode earned little more than standing still would have."""
        return episode_return < 0.75 * self._still

    def _draw_context(self, starts_session: bool) -> None:
        self._wanted = [self.targets[self.np_random.integers(len(self.targets))]]
        self._still = 0.0

    def _context(self) -> float:
        while len(self._wanted) <= self._step:
            self._wanted.append(self._following(self._wanted[-1]))
        return self._wanted[self._step]

    def _following(self, wanted: float) -> float:
        others = [speed for speed in self.search_targets if speed != wanted]
        if not others or self.np_random.random() >= self.change:
            return wanted
        return others[self.np_random.integers(len(others))]

    def _reward(self, speed: float, action: np.ndarray) -> float:
        rewarded = np.array(self._rewarded())
        self._still -= float(rewarded @ rewarded)
        return -float(((speed - rewarded) ** 2).sum())

    def _rewarded(self) -> list[float]:
        """The wanted speeds that the step under way is paid for."""
        raise NotImplementedError

    def _past(self, back: int) -> float:
        """`c_{t - back}`."""
        return self._wanted[max(self._step - back, 0)]


class CheetahDelayedS(CheetahGoal, name="cheetah-delayed-s", id="ada/CheetahDelayed-S-v0"):
    """A wanted speed `c_t` that changes within the episode and is paid for `delay` steps later:

        r_t = -(v_t - c_{t - delay})^2,        that is        r_{t + delay} = -(v_{t + delay} - c_t)^2

    The context of step t is `c_t`, the wish that is made in step t. It does not act on `r_t` but on `r_{t + delay}`: who sees it
    has `delay` steps to get there. Nothing of it shows in the observation, and it shows in the reward `delay` steps later.

    Args:
        delay: `l` of the paper, steps of .05 s; 0 rewards at once.
        targets: the speeds, m/s.
        change: probability that a step wants another of them than the last step.
        render_mode: `rgb_array` or None.
    """

    def __init__(self, delay: int = 5, targets: Sequence[float] = TARGETS, change: float = CHANGE, render_mode: str | None = None) -> None:
        self.delay = _whole("delay", delay, 0)
        super().__init__(targets, change, render_mode)

    def _rewarded(self) -> list[float]:
        return [self._past(self.delay)]


class CheetahCumulativeS(CheetahGoal, name="cheetah-cumulative-s", id="ada/CheetahCumulative-S-v0"):
    """A wanted speed `c_t` that changes within the episode and is paid for in `horizon` steps, its own and those after it:

        r_t = -sum_{k = 0}^{horizon - 1} (v_t - c_{t - k})^2

    The context of step t is `c_t`, the wish that is made in step t; it acts on `r_t, ..., r_{t + horizon - 1}`. The best speed is the mean
    of the last `horizon` wishes.

    Args:
        horizon: `L` of the paper, steps of .05 s; 1 rewards at once.
        targets: the speeds, m/s.
        change: probability that a step wants another of them than the last step.
        render_mode: `rgb_array` or None.
    """

    def __init__(
        self, horizon: int = 5, targets: Sequence[float] = TARGETS, change: float = CHANGE, render_mode: str | None = None
    ) -> None:
        self.horizon = _whole("horizon", horizon, 1)
        super().__init__(targets, change, render_mode)

    def _rewarded(self) -> list[float]:
        return [self._past(back) for back in range(self.horizon)]


def _whole(option: str, value: Any, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{option} must be a whole number of steps, {least} at least, not {value!r}")
    return int(value)
