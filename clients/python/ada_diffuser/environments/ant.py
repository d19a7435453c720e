"""The ant's body: Gymnasium's Ant-v5 model, stepped directly in MuJoCo."""

from __future__ import annotations

from pathlib import Path

import gymnasium.envs.mujoco
import mujoco
import numpy as np

XML = Path(gymnasium.envs.mujoco.__file__).parent / "assets" / "ant.xml"
FRAME_SKIP = 5
RESET_NOISE = 0.1


class AntBody:
    """Dynamics alone: no reward, no context, no end, no Gymnasium call."""

    def __init__(self) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(XML))
        self.data = mujoco.MjData(self.model)
        self.dt = self.model.opt.timestep * FRAME_SKIP
        # MuJoCo's bindings make a new view of their arrays at each look, and a search looks millions of times.
        self._position, self._velocity, self._control = self.data.qpos, self.data.qvel, self.data.ctrl
        self._rest = self.data.qpos.copy()

    def reset(self, rng: np.random.Generator) -> None:
        """Stand near the rest pose with Gymnasium's reset noise."""
        mujoco.mj_resetData(self.model, self.data)
        self._position[:] = self._rest + rng.uniform(-RESET_NOISE, RESET_NOISE, self.model.nq)
        self._velocity[:] = RESET_NOISE * rng.standard_normal(self.model.nv)
        mujoco.mj_forward(self.model, self.data)

    def step(self, action: np.ndarray) -> float:
        """Execute `action` (8,) for .05 s; returns the mean speed of the torso along x in m/s."""
        before = self.x
        self._control[:] = action
        mujoco.mj_step(self.model, self.data, nstep=FRAME_SKIP)
        return (self.x - before) / self.dt

    def observation(self) -> np.ndarray:
        """Positions without x and y, then velocities, shape (27,), float32; see the task for why no contact forces."""
        return np.concatenate([self._position[2:], self._velocity]).astype(np.float32)

    @property
    def x(self) -> float:
        """Distance of the torso from the start along x, m."""
        return float(self._position[0])
