"""The cheetah's tasks: a wind that it cannot feel, or a wanted speed that nobody tells it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .half_cheetah import HalfCheetahBody
from .running import RunningTask
from .search import Search

ACTION_COST = 0.05
WIND_TARGET = 1.5
"""Wanted speed of the wind tasks, m/s."""
GRID_SPEEDS = (0.5, 1.0, 1.5, 2.0, 2.5)
"""Speeds that get an expert of their own where the environment draws from a continuum."""


class CheetahTask(RunningTask):
    """What the cheetah tasks share: reward `-|v - v*| - .05 a.a` unless they say another."""

    action_noise = (0.0, 0.05, 0.1)  # more of it stops the gait
    body: HalfCheetahBody

    def __init__(self, wind_on: str = "torso", render_mode: str | None = None) -> None:
        super().__init__(HalfCheetahBody(wind_on), render_mode)

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode earned little more than standing still would have."""
        return episode_return < -0.75 * self.episode_steps * self._target()

    def _move(self, action: np.ndarray) -> float:
        return self.body.step(action, self._wind())

    def _wind(self) -> float:
        return 0.0

    def _reward(self, speed: float, action: np.ndarray) -> float:
        return -abs(speed - self._target()) - ACTION_COST * float(action @ action)

    def _target(self) -> float:
        return WIND_TARGET


class _CheetahWind(CheetahTask):
    """A head wind of `gain * (mean + swing sin(rate * clock + phi))` N; the context is that force."""

    search = Search(varies={"gain": 0.2})  # a gait that knows one strength alone is fragile
    mean: float
    swing: float
    rate: float

    def __init__(
        self,
        gain: float = 1.0,
        phase: float | None = None,
        wind_on: str = "torso",
        render_mode: str | None = None,
    ) -> None:
        super().__init__(wind_on, render_mode)
        self.gain = gain
        self.phase = phase
        self._phi = 0.0

    def _draw_phase(self) -> None:
        drawn = self.np_random.uniform(0.0, 2.0 * math.pi)
        self._phi = drawn if self.phase is None else self.phase

    def _clock(self) -> int:
        raise NotImplementedError

    def _context(self) -> float:
        return self._force(self._clock())

    def _force(self, clock: int) -> float:
        return self.gain * (self.mean + self.swing * math.sin(self.rate * clock + self._phi))

    def _wind(self) -> float:
        return self._context()


class CheetahWindS(_CheetahWind, name="cheetah-wind-s", id="ada/CheetahWind-S-v0"):
    """Wind `5 + 5 sin(.5 t + phi)` N in step `t`: 0 to 10 N, a period of 12.6 steps.

    Args:
        gain: factor on the force.
        phase: `phi`, or None to draw it in each episode; 0 is the paper's wind.
        wind_on: `torso` (default), `all_bodies` or `rootx`.
        render_mode: `rgb_array` or None.
    """

    mean, swing, rate = 5.0, 5.0, 0.5

    def _draw_context(self, starts_session: bool) -> None:
        self._draw_phase()

    def _clock(self) -> int:
        return self._step

    def _coming(self, steps: int) -> list[float]:
        return [self._force(self._step + ahead) for ahead in range(steps)]


class CheetahWindE(_CheetahWind, name="cheetah-wind-e", id="ada/CheetahWind-E-v0"):
    """Wind `10 + 5 sin(.8 i + phi)` N throughout episode `i`: 5 to 15 N.

    Args:
        gain: factor on the force.
        phase: `phi`, or None to draw it in each session; 0 is the paper's wind.
        wind_on: `torso` (default), `all_bodies` or `rootx`.
        render_mode: `rgb_array` or None.
    """

    mean, swing, rate = 10.0, 5.0, 0.8

    def _draw_context(self, starts_session: bool) -> None:
        if starts_session:
            self._draw_phase()

    def _clock(self) -> int:
        return self._episode


class CheetahVelE(CheetahTask, name="cheetah-vel-e", id="ada/CheetahVel-E-v0"):
    """A wanted speed that is constant within an episode and shows only in the reward.

    Args:
        targets: the speeds to draw from, or `uniform` for U(0, 3), or `lilac` for 1.5 + 1.5 sin(.5 i + phi) in episode `i`.
        render_mode: `rgb_array` or None.
        phase: `phi` of `lilac`, or None to draw it in each session; 0, the paper's, gives all sessions the same speeds.
    """

    search = Search(holds="targets")

    def __init__(self, targets: str | Sequence[float] = (1.0, 2.5), render_mode: str | None = None, phase: float | None = 0.0) -> None:
        super().__init__(render_mode=render_mode)
        if isinstance(targets, str):
            if targets not in ("uniform", "lilac"):
                raise ValueError(f"targets must be speeds, 'uniform' or 'lilac', not {targets!r}")
        elif not targets:
            raise ValueError("targets must name at least one speed")
        self.targets = targets if isinstance(targets, str) else tuple(float(v) for v in targets)
        self.phase = phase
        self._phi = self._speed = 0.0

    @property
    def search_targets(self) -> tuple[float, ...]:
        """One policy a speed."""
        return GRID_SPEEDS if isinstance(self.targets, str) else tuple(sorted(set(self.targets)))

    def _draw_context(self, starts_session: bool) -> None:
        if self.targets == "uniform":
            self._speed = self.np_random.uniform(0.0, 3.0)
        elif self.targets == "lilac":
            if starts_session:
                self._phi = self.np_random.uniform(0.0, 2.0 * math.pi) if self.phase is None else self.phase
            self._speed = 1.5 + 1.5 * math.sin(0.5 * self._episode + self._phi)
        else:
            self._speed = self.targets[self.np_random.integers(len(self.targets))]

    def _context(self) -> float:
        return self._speed

    def _target(self) -> float:
        return self._speed
