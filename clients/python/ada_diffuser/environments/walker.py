"""Gymnasium's Walker2d-v5, with nothing hidden: what D4RL's walker2d data sets are of."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco.walker2d_v5 import Walker2dEnv

from .search import ArsSettings, Search
from .task import References, Task


class Walker2d(Task, Walker2dEnv, name="walker2d", id="ada/Walker2d-v0"):
    """Gymnasium's Walker2d-v5 as it is, with observations of 32 bits.

        r = v + 1 (unless it has fallen) - .001 a.a, v in m/s                   1000 steps of .008 s, fewer where it falls

    Its expert is the best policy of one search of 150 iterations, 4800 episodes; it is linear. On 48 fresh episodes it earns 2919 ± 38
    without noise and 2294 ± 113 with that of the data, where D4RL's expert has 4592; the policy of iteration 120 earns a third, 876 ± 26 in
    60 episodes.

    Args:
        render_mode: `rgb_array` or None.
    """

    episode_steps = 1000
    search = Search(
        searches=1,
        ars=ArsSettings(iterations=150, directions=16, top=8, noise=0.025),
        practice={"_healthy_reward": 0.0},  # else it learns to stand
        keeps_run=True,
    )
    references = References(random=1.629008, expert=4592.3)

    def __init__(self, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array or None, not {render_mode!r}")
        super().__init__(render_mode=render_mode)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / self.dt)}
        self.observation_space = spaces.Box(-np.inf, np.inf, self.observation_space.shape, np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        observation, info = super().reset(seed=seed, options=options)
        return observation.astype(np.float32), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance .008 s by the action, clipped to [-1, 1] before anything else; see `gymnasium.Env.step`."""
        clipped = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        observation, reward, terminated, truncated, info = super().step(clipped)
        return observation.astype(np.float32), float(reward), bool(terminated), truncated, info
