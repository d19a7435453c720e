"""PendulumGravity-E: a pendulum to be swung up and balanced under a gravity that nobody names."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.envs.classic_control.pendulum import PendulumEnv

from .task import HiddenTask, checked_range

GRAVITY = (4.0, 16.0)
"""Least and largest gravity, m/s^2; the mean is Pendulum-v1's."""
CATCH_TORQUE = 6.0
"""The pilot balances where its law asks for no more than this, three times what the motor has; it pumps elsewhere."""
FAILED_RETURN = -600.0
"""Between the worst episode of the pilot that is told the gravity (-415) and the best that it does not balance, taking it for 10 (-745)."""
RENDER_SIDE = 360
ROD = 130
"""Pixels."""


class PendulumGravityE(HiddenTask, PendulumEnv, name="pendulum-gravity-e", id="ada/PendulumGravity-E-v0"):
    """Gymnasium's Pendulum-v1 with a gravity `g ~ U(4, 16)` drawn once an episode, the hidden context in R.

    Observation `(cos theta, sin theta, omega)`, theta = 0 upright; action a torque in [-2, 2], clipped before anything else.

        omega' = clip(omega + .05 (1.5 g sin theta + 3 u), -8, 8)        theta' = theta + .05 omega'
        r = -theta^2 - .1 omega^2 - .001 u^2, before the step, theta in [-pi, pi)

    What gravity is worth to know, 64 episodes from seed 1000:

        the pilot                           mean return    not upright at the end
        is told the gravity                  -162 ± 12      0
        takes it for 10, the mean            -396 ± 54     17
        takes it for 12, the best number     -273 ± 39      9
        draws its actions at random         -1291 ± 32     64

    Args:
        gravity: least and largest gravity.
        render_mode: `rgb_array` or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (Gymnasium's own spelling)
    action_noise = (0.0, 0.2, 0.4)

    def __init__(self, gravity: Sequence[float] = GRAVITY, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array or None, not {render_mode!r}")
        self.gravity = checked_range("gravity", gravity)
        super().__init__(render_mode)

    @property
    def context(self) -> np.ndarray:
        """The gravity, shape (1,)."""
        return np.array([self.g], np.float32)

    def coming_context(self, steps: int) -> np.ndarray:
        """See `HiddenTask`."""
        return np.tile(self.context, (steps, 1))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; `options` are Pendulum-v1's."""
        observation, _ = super().reset(seed=seed, options=options)
        self.g = float(np.float32(self.np_random.uniform(*self.gravity)))  # to the last bit what `context` tells
        return observation, {"context": self.context}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance .05 s; see `gymnasium.Env.step`."""
        observation, reward, terminated, truncated, _ = super().step(np.asarray(action, np.float64))
        return observation, float(reward), terminated, truncated, {"context": self.context}

    def expert_action(self, observation: np.ndarray, context: np.ndarray) -> np.ndarray:
        """clip(-g/2 sin theta - 4 theta - 2 omega) where that is at most 6 and the rod points up, else sign(omega) clip(-E)

        `E = omega^2 / 2 - 1.5 g (1 - cos theta)` is the energy that the rod has beyond what it takes to come to rest upright.
        """
        cosine, sine, omega = (float(value) for value in observation)
        gravity = float(context[0])
        balance = -gravity / 2 * sine - 4 * math.atan2(sine, cosine) - 2 * omega
        if cosine > 0 and abs(balance) <= CATCH_TORQUE:
            return np.clip([balance], -self.max_torque, self.max_torque)
        energy = omega**2 / 2 - 1.5 * gravity * (1 - cosine)
        return math.copysign(1.0, omega) * np.clip([-energy], -self.max_torque, self.max_torque)

    @property
    def mean_context(self) -> np.ndarray:
        """The middle of the range."""
        return np.array([sum(self.gravity) / 2], np.float32)

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode earned what it does where a pilot with the wrong gravity never gets upright."""
        return episode_return < FAILED_RETURN

    def render(self) -> np.ndarray | None:
        """One frame (360, 360, 3) uint8: the rod, gravity as a red line down from its axle, the last torque as a bar at the bottom."""
        if self.render_mode is None:
            return None
        from PIL import Image, ImageDraw

        theta, centre = self.state[0], RENDER_SIDE / 2
        frame = Image.new("RGB", (RENDER_SIDE, RENDER_SIDE), "white")
        draw = ImageDraw.Draw(frame)
        draw.line((centre, 8, centre, 24), fill="gray")
        draw.line((centre, centre, centre, centre + 8 * self.g), fill=(200, 60, 40), width=2)
        tip = centre - ROD * math.sin(theta), centre - ROD * math.cos(theta)
        draw.line((centre, centre, *tip), fill=(30, 90, 180), width=12)
        draw.ellipse((centre - 5, centre - 5, centre + 5, centre + 5), fill="black")
        torque = 0.0 if self.last_u is None else float(self.last_u)
        end = centre - ROD * torque / self.max_torque
        draw.rectangle((min(centre, end), RENDER_SIDE - 20, max(centre, end), RENDER_SIDE - 12), fill=(160, 190, 230))
        return np.asarray(frame)
