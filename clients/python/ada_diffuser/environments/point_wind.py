"""PointWind-S: a point mass that should stay at the origin in a wind it cannot see."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

DT = 0.1
THRUST = 4.0
DRAG = 0.8
WIND_MEAN = 2.0
WIND_SWING = 2.0
ACTION_COST = 0.05
FAILED_RETURN = -60.0
"""Below what a pilot reaches that knows only the mean wind (-47)."""


class PointWindS(gym.Env[np.ndarray, np.ndarray]):
    """State `(p, v)` in R^4, action in [-1, 1]^2, hidden context `w_t u` in R^2.

        v' = v + dt (4 a - .8 v + w_t u) + sigma N(0, I)        p' = p + dt v'
        w_t = 2 + 2 sin(omega t + phi)                          r = -|p'| - .05 a.a

    `u` is a random unit vector and `phi` a random phase, both drawn once an episode. `p_0 ~ U(-1, 1)^2`, `v_0 = 0`.
    The action is clipped to its box before anything else.

    Args:
        omega: angular speed of the wind, radians a step.
        sigma: standard deviation of the process noise on the velocity.
        phase: `phi`, or None to draw it in each episode.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own spelling)

    def __init__(self, omega: float = 0.2, sigma: float = 0.03, phase: float | None = None) -> None:
        self.omega = omega
        self.sigma = sigma
        self.phase = phase
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.render_mode = None
        self._position = np.zeros(2)
        self._velocity = np.zeros(2)
        self._direction = np.array([1.0, 0.0])
        self._phi = 0.0
        self._step = 0

    @property
    def context(self) -> np.ndarray:
        """The wind `w_t u` that acts on the coming step, shape (2,)."""
        wind = WIND_MEAN + WIND_SWING * math.sin(self.omega * self._step + self._phi)
        return (wind * self._direction).astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        super().reset(seed=seed)
        self._position = self.np_random.uniform(-1.0, 1.0, 2)
        self._velocity = np.zeros(2)
        angle, phi = self.np_random.uniform(0.0, 2.0 * math.pi, 2)
        self._direction = np.array([math.cos(angle), math.sin(angle)])
        self._phi = phi if self.phase is None else self.phase
        self._step = 0
        return self._observation(), {"context": self.context}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance .1 s; see `gymnasium.Env.step`."""
        action = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        wind = self.context
        push = THRUST * action - DRAG * self._velocity + wind
        self._velocity = self._velocity + DT * push + self.sigma * self.np_random.standard_normal(2)
        self._position = self._position + DT * self._velocity
        self._step += 1
        reward = -float(np.linalg.norm(self._position)) - ACTION_COST * float(action @ action)
        return self._observation(), reward, False, False, {"context": wind}

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode did worse than a pilot that ignores how the wind changes."""
        return episode_return < FAILED_RETURN

    def _observation(self) -> np.ndarray:
        return np.concatenate([self._position, self._velocity]).astype(np.float32)
