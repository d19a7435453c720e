"""The cheetah under something that jumps now and then within the episode: a wind, or a wanted speed that is rewarded later."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import numpy as np

from .cheetah import CheetahTask
from .search import ArsSettings, Search

CHANGE = 0.02
"""Probability of another value, a step."""
WINDS = (-40.0, 15.0)
"""Head winds, N; one below 0 blows from behind."""
SPEEDS = (1.0, 2.5)
"""Wanted speeds, m/s."""


class CheetahSwitching(CheetahTask):
    """What they share: `c_0` is one of some values, and in each step another takes its place with probability `change`."""

    def __init__(self, option: str, values: Sequence[float], change: float, wind_on: str = "torso", render_mode: str | None = None) -> None:
        if isinstance(values, str) or not values or not all(math.isfinite(value) for value in values):
            raise ValueError(f"{option} must be at least one finite number, not {values!r}")
        if not 0.0 <= change <= 1.0:
            raise ValueError(f"change must be a probability, not {change!r}")
        super().__init__(wind_on, render_mode)
        self.values, self.change = tuple(float(value) for value in values), float(change)
        self._drawn = [self.values[0]]
        """`c_0` to the last one that was asked for."""

    @property
    def search_targets(self) -> tuple[float, ...]:
        """One policy a value."""
        return tuple(sorted(set(self.values)))

    def _draw_context(self, starts_session: bool) -> None:
        self._drawn = [self.values[self.np_random.integers(len(self.values))]]

    def _context(self) -> float:
        while len(self._drawn) <= self._step:
            self._drawn.append(self._following(self._drawn[-1], self.np_random))
        return self._drawn[self._step]

    def _coming(self, steps: int) -> list[float]:
        """What the steps to come will draw, drawn by a copy of the generator."""
        drawn, rng = list(self._drawn), deepcopy(self.np_random)
        while len(drawn) < self._step + steps:
            drawn.append(self._following(drawn[-1], rng))
        return drawn[self._step : self._step + steps]

    def _following(self, value: float, rng: np.random.Generator) -> float:
        others = [other for other in self.search_targets if other != value]
        if not others or rng.random() >= self.change:
            return value
        return others[rng.integers(len(others))]


class CheetahGaleS(CheetahSwitching, name="cheetah-gale-s", id="ada/CheetahGale-S-v0"):
    """A strong wind on the torso that turns round: from behind, or from ahead, with probability .02 a step from one to the other.

    The reward is that of the other winds, `-|v - 1.5| - .05 a.a`, and the context of step t the force in step t, N, against the run. No
    one gait is good in both winds, and the expert has one for each: it changes its gait in the step in which the wind turns.

    What the wind is worth to know, 64 episodes from seed 1000:

        gait                                                     mean return    failed
        the expert's, that of the wind                             -68 ±  2       0
        the best blind one known, searched for from a walk        -109 ±  5       1
        a blind one searched for as the expert's were             -199 ±  8      18
        the expert's for the wind from ahead, in both             -209 ± 11      30
        the expert's for the wind from behind, in both            -229 ±  9      43

    Args:
        winds: the forces against the run, N; below 0: from behind.
        change: probability that a step has another of them than the last step.
        wind_on: `torso` (default), `all_bodies` or `rootx`.
        render_mode: `rgb_array` or None.
    """

    search = Search(holds="winds", searches=1, ars=ArsSettings(iterations=120))

    def __init__(
        self, winds: Sequence[float] = WINDS, change: float = CHANGE, wind_on: str = "torso", render_mode: str | None = None
    ) -> None:
        super().__init__("winds", winds, change, wind_on, render_mode)

    def _wind(self) -> float:
        return self._context()


class CheetahGoal(CheetahSwitching):
    """What the two below share: a wanted speed `c_t`, and a reward of squares alone, as the paper has it.

    Steps before the first are taken to have wanted `c_0`.
    """

    search = Search(holds="targets", searches=1, ars=ArsSettings(iterations=120))

    def __init__(self, targets: Sequence[float], change: float, render_mode: str | None) -> None:
        super().__init__("targets", targets, change, render_mode=render_mode)
        if min(self.values) <= 0.0:
            raise ValueError(f"targets must be above 0, not {targets!r}")
        self._still = 0.0
        """What standing still would have earned so far."""

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode earned little more than standing still would have."""
        return episode_return < 0.75 * self._still

    def _draw_context(self, starts_session: bool) -> None:
        super()._draw_context(starts_session)
        self._still = 0.0

    def _reward(self, speed: float, action: np.ndarray) -> float:
        rewarded = np.array(self._rewarded())
        self._still -= float(rewarded @ rewarded)
        return -float(((speed - rewarded) ** 2).sum())

    def _rewarded(self) -> list[float]:
        """The wanted speeds that the step under way is paid for."""
        raise NotImplementedError

    def _past(self, back: int) -> float:
        """`c_{t - back}`."""
        return self._drawn[max(self._step - back, 0)]


class CheetahDelayedS(CheetahGoal, name="cheetah-delayed-s", id="ada/CheetahDelayed-S-v0"):
    """A wanted speed `c_t` that changes within the episode and is paid for `delay` steps later:

        r_t = -(v_t - c_{t - delay})^2,        that is        r_{t + delay} = -(v_{t + delay} - c_t)^2

    The context of step t is `c_t`, the wish that is made in step t. It does not act on `r_t` but on `r_{t + delay}`: who sees it
    has `delay` steps to get there. Nothing of it shows in the observation, and it shows in the reward `delay` steps later.

    Cheetah-Vel-E's two gaits, whichever `c_t` wants, earn -65 ± 4, a blind one searched for -187 ± 9 (64 episodes from seed 1000, none
    failed).

    Args:
        delay: `l` of the paper, steps of .05 s; 0 rewards at once.
        targets: the speeds, m/s.
        change: probability that a step wants another of them than the last step.
        render_mode: `rgb_array` or None.
    """

    def __init__(self, delay: int = 5, targets: Sequence[float] = SPEEDS, change: float = CHANGE, render_mode: str | None = None) -> None:
        self.delay = _whole("delay", delay, 0)
        super().__init__(targets, change, render_mode)

    def _rewarded(self) -> list[float]:
        return [self._past(self.delay)]


class CheetahCumulativeS(CheetahGoal, name="cheetah-cumulative-s", id="ada/CheetahCumulative-S-v0"):
    """A wanted speed `c_t` that changes within the episode and is paid for in `horizon` steps, its own and those after it:

        r_t = -sum_{k = 0}^{horizon - 1} (v_t - c_{t - k})^2

    The context of step t is `c_t`, the wish that is made in step t; it acts on `r_t, ..., r_{t + horizon - 1}`. The best speed is the mean
    of the last `horizon` wishes.

    Cheetah-Vel-E's two gaits, whichever `c_t` wants, earn -363 ± 22 (64 episodes from seed 1000, none failed).

    Args:
        horizon: `L` of the paper, steps of .05 s; 1 rewards at once.
        targets: the speeds, m/s.
        change: probability that a step wants another of them than the last step.
        render_mode: `rgb_array` or None.
    """

    def __init__(self, horizon: int = 5, targets: Sequence[float] = SPEEDS, change: float = CHANGE, render_mode: str | None = None) -> None:
        self.horizon = _whole("horizon", horizon, 1)
        super().__init__(targets, change, render_mode)

    def _rewarded(self) -> list[float]:
        return [self._past(back) for back in range(self.horizon)]


def _whole(option: str, value: Any, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"{option} must be a whole number of steps, {least} at least, not {value!r}")
    return int(value)
