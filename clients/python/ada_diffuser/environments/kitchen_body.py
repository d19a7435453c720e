"""The Franka robot in its kitchen: the model of gymnasium-robotics' FrankaKitchen-v1, stepped directly in MuJoCo."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from .extra import robotics

FRAME_SKIP = 40
ROBOT = 9
"""Joints of the robot: seven of the arm, two fingers; they are the first of all positions, velocities and controls."""
SPEED = 2.0
"""Of a joint at an action of 1, rad/s; of a finger m/s."""
JOINTS_LOW = np.array([-2.9, -1.8, -2.9, -3.1, -2.9, 0.0, -2.9, 0.0, 0.0])
JOINTS_HIGH = np.array([2.9, 1.8, 2.9, 0.0, 2.9, 3.8, 2.9, 0.04, 0.04])
"""What joints are sent to at most, as in the environment's own `franka_config.xml`."""
ROBOT_NOISE = 1e-3
OBJECT_NOISE = 2.5e-6
"""Half widths of the noise on what is observed, of positions and velocities alike, to the size of the environment's own."""
START = np.array(
    [0.148388, -1.768486, 1.843903, -2.476858, 0.260252, 0.712533, 1.595154, 0.047927, 0.037135]  # the robot
    + [0.0] * 14
    + [-0.269397, 0.350383, 1.619447, 1.006188, 0.004064, -0.006621, -0.000268]  # the kettle, (x, y, z) and quaternion
)
"""Positions of an episode's begin, to a thousandth those of the environment's own."""


class KitchenBody:
    """Dynamics alone: no reward, no goal, no Gymnasium call. Raises `ImportError` without gymnasium-robotics."""

    def __init__(self) -> None:
        folder = Path(robotics("envs").__file__).parent / "assets" / "kitchen_franka" / "kitchen_assets"
        self.model = mujoco.MjModel.from_xml_path(str(folder / "kitchen_env_model.xml"))
        self.data = mujoco.MjData(self.model)
        self.dt = self.model.opt.timestep * FRAME_SKIP
        self._seen = START[:ROBOT]

    def reset(self, rng: np.random.Generator) -> np.ndarray:
        """Stand at `START`; returns what is observed, see `observe`."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = START
        mujoco.mj_forward(self.model, self.data)
        return self.observe(rng)

    def step(self, action: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Have the joints go at `action` (9,), in [-1, 1], for .08 s; returns what is observed then.

        Each joint is sent to where it was last observed, and as far on as its speed takes it. The noise of that observation is in it.
        """
        wanted = self._seen + np.clip(action, -1.0, 1.0) * SPEED * self.dt
        self.data.ctrl[:] = np.clip(wanted, JOINTS_LOW, JOINTS_HIGH)
        mujoco.mj_step(self.model, self.data, nstep=FRAME_SKIP)
        return self.observe(rng)

    def observe(self, rng: np.random.Generator) -> np.ndarray:
        """Positions and velocities of the robot, (9,) each, then of the things, (21,) and (20,); with noise."""
        robot = np.concatenate([self.data.qpos[:ROBOT], self.data.qvel[:ROBOT]])
        things = np.concatenate([self.data.qpos[ROBOT:], self.data.qvel[ROBOT:]])
        robot += ROBOT_NOISE * rng.uniform(-1.0, 1.0, robot.size)
        things += OBJECT_NOISE * rng.uniform(-1.0, 1.0, things.size)
        self._seen = robot[:ROBOT]
        return np.concatenate([robot, things])
