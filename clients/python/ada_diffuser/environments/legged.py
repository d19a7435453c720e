"""Gymnasium's legged robots with one number of their physics drawn anew in each episode, and told to nobody."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import mujoco
import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco.hopper_v5 import HopperEnv
from gymnasium.envs.mujoco.mujoco_env import MujocoEnv
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv

from .search import ArsSettings, Search
from .task import HiddenTask, checked_range

GRAVITY = (6.0, 14.0)
"""Least and largest gravity, m/s^2; Hopper-v5 has 9.81."""
MASS = (0.5, 2.0)
"""Least and largest factor on the torso's mass; Walker2d-v5 has 1."""


class LeggedTask(HiddenTask, MujocoEnv):
    """What they share: the context `c ~ U(least, largest)`, once an episode; Gymnasium's reward, and Gymnasium's end where it falls.

    A fall ends the episode, as in Gymnasium: `terminated`, and `terminals` in the data, whose episodes are of different lengths. A recipe
    leaves out those that are shorter than its plan and its `losses.elbo.length + 1`. The action is clipped to [-1, 1] before anything else.
    """

    episode_steps = 400
    action_noise = (0.0, 0.05, 0.1)
    search = Search(searches=1, ars=ArsSettings(iterations=150, noise=0.025), practice={"_healthy_reward": 0.0})  # else it learns to stand
    failed_return: ClassVar[float]
    """Below this an episode counts as failed."""

    def __init__(self, span: tuple[float, float], render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array or None, not {render_mode!r}")
        super().__init__(render_mode=render_mode)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / self.dt)}
        self.observation_space = spaces.Box(-np.inf, np.inf, self.observation_space.shape, np.float32)
        self._span, self._drawn = span, float("nan")

    @property
    def context(self) -> np.ndarray:
        """The hidden number of the episode, shape (1,)."""
        return np.array([self._drawn], np.float32)

    def coming_context(self, steps: int) -> np.ndarray:
        """See `HiddenTask`."""
        return np.tile(self.context, (steps, 1))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        _, info = super().reset(seed=seed, options=options)
        self._drawn = float(np.float32(self.np_random.uniform(*self._span)))  # to the last bit what `context` tells
        self._apply(self._drawn)
        return self._get_obs().astype(np.float32), {**info, "context": self.context}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance .008 s; see `gymnasium.Env.step`."""
        clipped = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        observation, reward, terminated, truncated, info = super().step(clipped)
        return observation.astype(np.float32), float(reward), bool(terminated), truncated, {**info, "context": self.context}

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode earned what it does where it soon falls or stands still."""
        return episode_return < self.failed_return

    def _apply(self, drawn: float) -> None:
        """Make the model one of this context, whatever it was before."""
        raise NotImplementedError


class HopperGravityE(LeggedTask, HopperEnv, name="hopper-gravity-e", id="ada/HopperGravity-E-v0"):
    """Gymnasium's Hopper-v5 under a gravity `g ~ U(6, 14)` m/s^2 drawn once an episode, the hidden context in R.

        r = v + 1 (unless it has fallen) - .001 a.a, v in m/s                   400 steps of .008 s, fewer where it falls

    What gravity is worth to know, 64 episodes from seed 1000:

        the expert                         mean return    failed
        is told the gravity                 1120 ± 22      0
        takes it for 10, the mean            952 ± 41     14

    It runs more than it hops, and most of its episodes end in a fall: of 300 with action noise 234, none before step 248.

    Args:
        gravity: least and largest gravity.
        render_mode: `rgb_array` or None.
    """

    failed_return = 400.0

    def __init__(self, gravity: Sequence[float] = GRAVITY, render_mode: str | None = None) -> None:
        self.gravity = checked_range("gravity", gravity)
        super().__init__(self.gravity, render_mode)

    def _apply(self, drawn: float) -> None:
        self.model.opt.gravity[2] = -drawn


class WalkerMassE(LeggedTask, Walker2dEnv, name="walker-mass-e", id="ada/WalkerMass-E-v0"):
    """Gymnasium's Walker2d-v5 whose torso has `m ~ U(.5, 2)` times its mass and inertia, drawn once an episode, the hidden context in R.

        r = v + 1 (unless it has fallen) - .001 a.a, v in m/s                   400 steps of .008 s, fewer where it falls

    The best expert of six searches of 300 iterations earns 482 on 48 episodes with action noise: it runs with a torso of up to 1.1 times
    the mass (1000) and falls at once with one of more than 1.4 (10). What the mass is worth to know has not been measured.

    Args:
        mass: least and largest factor.
        render_mode: `rgb_array` or None.
    """

    failed_return = 400.0

    def __init__(self, mass: Sequence[float] = MASS, render_mode: str | None = None) -> None:
        self.mass = checked_range("mass", mass)
        super().__init__(self.mass, render_mode)
        torso = self.model.body("torso")
        self._torso, self._unloaded = torso.id, (float(torso.mass[0]), torso.inertia.copy())

    def _apply(self, drawn: float) -> None:
        mass, inertia = self._unloaded
        self.model.body_mass[self._torso] = drawn * mass
        self.model.body_inertia[self._torso] = drawn * inertia
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))  # what contacts and limits reckon with
