"""PendulumTorque-S: a pendulum to be swung up and balanced against a torque that nobody sees and that turns up and down."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium.envs.classic_control.pendulum import PendulumEnv, angle_normalize

from .task import HiddenTask

CATCH_TORQUE = 6.0
"""The pilot balances where its law asks for no more than this, three times what the motor has; it pumps elsewhere."""
FAILED_RETURN = -480.0
"""Below the worst episode of the pilot that is told the torque (-472)."""
SWING_MAX = 1.5
"""A stronger torque leaves the motor too little."""


class PendulumTorqueS(HiddenTask, PendulumEnv, name="pendulum-torque-s", id="ada/PendulumTorque-S-v0"):
    """Gymnasium's Pendulum-v1 with a second torque `w_t = swing sin(rate t + phi)` on its axle, the hidden context in R.

    Observation `(cos theta, sin theta, omega)`, theta = 0 upright; action a torque in [-2, 2], clipped before anything else.

        omega' = clip(omega + .05 (15 sin theta + 3 (u + w)), -8, 8)        theta' = theta + .05 omega'
        r = -theta^2 - .1 omega^2 - .001 u^2, before the step, theta in [-pi, pi)

    What the torque is worth to know, 64 episodes from seed 1000:

        the pilot                           mean return    not upright at the end
        is told the torque                   -184 ± 13      0
        is told that of 5 steps ago          -185 ± 13      0
        takes it for none                    -734 ± 10     64
        draws its actions at random         -1274 ± 28     64

    Args:
        swing: largest torque, N m; the motor has 2.
        rate: radians a step; a period is 63 steps.
        phase: `phi`, or None to draw it in each episode.
        render_mode: None; there is no film of it.
    """

    action_noise = (0.0, 0.2, 0.4)

    def __init__(self, swing: float = 1.3, rate: float = 0.1, phase: float | None = None, render_mode: str | None = None) -> None:
        if render_mode is not None:
            raise ValueError(f"render_mode must be None, not {render_mode!r}")
        if not 0.0 <= swing <= SWING_MAX:
            raise ValueError(f"swing must lie in 0..{SWING_MAX}, not {swing!r}: a stronger one cannot be held")
        super().__init__(None)
        self.swing, self.rate, self.phase = swing, rate, phase
        self._phi, self._step = 0.0, 0

    @property
    def context(self) -> np.ndarray:
        """The torque of the coming step, shape (1,)."""
        return self.coming_context(1)[0]

    def coming_context(self, steps: int) -> np.ndarray:
        """See `HiddenTask`."""
        ahead = range(self._step, self._step + steps)
        return np.array([[self.swing * math.sin(self.rate * step + self._phi)] for step in ahead], np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; `options` are Pendulum-v1's."""
        observation, _ = super().reset(seed=seed, options=options)
        drawn = float(self.np_random.uniform(0.0, 2.0 * math.pi))
        self._phi, self._step = drawn if self.phase is None else self.phase, 0
        return observation, {"context": self.context}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance .05 s; see `gymnasium.Env.step`."""
        context = self.context
        theta, omega = self.state
        torque = float(np.clip(np.asarray(action, np.float64), -self.max_torque, self.max_torque)[0])
        reward = -(angle_normalize(theta) ** 2 + 0.1 * omega**2 + 0.001 * torque**2)
        pull = 3 * self.g / (2 * self.l) * math.sin(theta) + 3.0 / (self.m * self.l**2) * (torque + float(context[0]))
        omega = float(np.clip(omega + pull * self.dt, -self.max_speed, self.max_speed))
        self.state = np.array([theta + omega * self.dt, omega])
        self.last_u = torque
        self._step += 1
        return self._get_obs(), float(reward), False, False, {"context": context}

    def expert_action(self, observation: np.ndarray, context: np.ndarray) -> np.ndarray:
        """clip(-5 sin theta - 4 theta - 2 omega - w) where that is at most 6 and the rod points up, else sign(omega) clip(-E) - w

        `E = omega^2 / 2 - 15 (1 - cos theta)` is the energy that the rod has beyond what it takes to come to rest upright.
        """
        cosine, sine, omega = (float(value) for value in observation)
        against = float(context[0])
        balance = -5.0 * sine - 4 * math.atan2(sine, cosine) - 2 * omega - against
        if cosine > 0 and abs(balance) <= CATCH_TORQUE:
            return np.clip([balance], -self.max_torque, self.max_torque)
        energy = omega**2 / 2 - 15.0 * (1 - cosine)
        pump = math.copysign(1.0, omega) * np.clip([-energy], -self.max_torque, self.max_torque)
        return np.clip(pump - against, -self.max_torque, self.max_torque)

    @property
    def mean_context(self) -> np.ndarray:
        """No torque: it turns both ways alike."""
        return np.zeros(1, np.float32)

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode earned what it does where the rod is not held."""
        return episode_return < FAILED_RETURN
