"""PointWind-S: a point mass that should stay at the origin in a wind it cannot see."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from .task import HiddenTask

DT = 0.1
THRUST = 4.0
DRAG = 0.8
WIND_MEAN = 2.0
WIND_SWING = 2.0
ACTION_COST = 0.05
FAILED_RETURN = -60.0
"""Below what a pilot reaches that knows only the mean wind (-47)."""
RENDER_SIDE = 360
RENDER_WORLD = 1.5
"""Half the side of the square that is drawn."""
TRAIL_STEPS = 26


class PointWindS(HiddenTask, name="point-wind-s", id="ada/PointWind-S-v0"):
    """State `(p, v)` in R^4, action in [-1, 1]^2, hidden context `w_t u` in R^2.

        v' = v + dt (4 a - .8 v + w_t u) + sigma N(0, I)        p' = p + dt v'
        w_t = 2 + 2 sin(omega t + phi)                          r = -|p'| - .05 a.a

    `u` is a random unit vector and `phi` a random phase, both drawn once an episode. `p_0 ~ U(-1, 1)^2`, `v_0 = 0`.
    The action is clipped to its box before anything else.

    Args:
        omega: angular speed of the wind, radians a step.
        sigma: standard deviation of the process noise on the velocity.
        phase: `phi`, or None to draw it in each episode.
        render_mode: `rgb_array` or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (Gymnasium's own spelling)
    action_noise = (0.1, 0.2, 0.3)

    def __init__(
        self,
        omega: float = 0.2,
        sigma: float = 0.03,
        phase: float | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array or None, not {render_mode!r}")
        self.omega = omega
        self.sigma = sigma
        self.phase = phase
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.render_mode = render_mode
        self._trail: list[np.ndarray] = []
        self._position = np.zeros(2)
        self._velocity = np.zeros(2)
        self._direction = np.array([1.0, 0.0])
        self._phi = 0.0
        self._step = 0

    @property
    def context(self) -> np.ndarray:
        """The wind `w_t u` that acts on the coming step, shape (2,)."""
        return self._wind(self._step)

    def coming_context(self, steps: int) -> np.ndarray:
        """See `HiddenTask`."""
        return np.stack([self._wind(self._step + ahead) for ahead in range(steps)])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        super().reset(seed=seed)
        self._position = self.np_random.uniform(-1.0, 1.0, 2)
        self._velocity = np.zeros(2)
        angle, phi = self.np_random.uniform(0.0, 2.0 * math.pi, 2)
        self._direction = np.array([math.cos(angle), math.sin(angle)])
        self._phi = phi if self.phase is None else self.phase
        self._step = 0
        self._trail = [self._position]
        return self._observation(), {"context": self.context}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance .1 s; see `gymnasium.Env.step`."""
        action = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        wind = self.context
        push = THRUST * action - DRAG * self._velocity + wind
        self._velocity = self._velocity + DT * push + self.sigma * self.np_random.standard_normal(2)
        self._position = self._position + DT * self._velocity
        self._step += 1
        self._trail = [*self._trail[1 - TRAIL_STEPS :], self._position]
        reward = -float(np.linalg.norm(self._position)) - ACTION_COST * float(action @ action)
        return self._observation(), reward, False, False, {"context": wind}

    def expert_action(self, observation: np.ndarray, context: np.ndarray) -> np.ndarray:
        """clip((-3 p - 2.5 v - w_t u) / 4)"""
        return (-3.0 * observation[:2] - 2.5 * observation[2:] - context) / 4.0

    @property
    def mean_context(self) -> np.ndarray:
        """No wind: it may come from anywhere."""
        return np.zeros(2, np.float32)

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode did worse than a pilot that ignores how the wind changes."""
        return episode_return < FAILED_RETURN

    def render(self) -> np.ndarray | None:
        """One frame (360, 360, 3) uint8: the mass with its trail, the goal as a cross, the wind of the coming step as a line."""
        if self.render_mode is None:
            return None
        from PIL import Image, ImageDraw

        centre = RENDER_SIDE / 2
        frame = Image.new("RGB", (RENDER_SIDE, RENDER_SIDE), "white")
        draw = ImageDraw.Draw(frame)
        draw.line((centre - 6, centre, centre + 6, centre), fill="gray")
        draw.line((centre, centre - 6, centre, centre + 6), fill="gray")
        trail = [_pixel(past) for past in self._trail]
        if len(trail) > 1:
            draw.line(trail, fill=(160, 190, 230), width=2)
        x, y = trail[-1]
        wind_x, wind_y = self.context * 12
        draw.line((x, y, x + wind_x, y - wind_y), fill=(200, 60, 40), width=2)
        draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=(30, 90, 180))
        return np.asarray(frame)

    def _wind(self, step: int) -> np.ndarray:
        wind = WIND_MEAN + WIND_SWING * math.sin(self.omega * step + self._phi)
        return (wind * self._direction).astype(np.float32)

    def _observation(self) -> np.ndarray:
        return np.concatenate([self._position, self._velocity]).astype(np.float32)


def _pixel(position: np.ndarray) -> tuple[float, float]:
    x, y = np.clip(position, -RENDER_WORLD, RENDER_WORLD) / RENDER_WORLD
    return (1 + float(x)) * RENDER_SIDE / 2, (1 - float(y)) * RENDER_SIDE / 2
