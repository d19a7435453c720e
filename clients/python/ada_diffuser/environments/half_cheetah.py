"""The half cheetah's body: Gymnasium's HalfCheetah-v5 model with a wind, stepped directly in MuJoCo."""

from __future__ import annotations

from pathlib import Path

import gymnasium.envs.mujoco
import mujoco
import numpy as np

XML = Path(gymnasium.envs.mujoco.__file__).parent / "assets" / "half_cheetah.xml"
FRAME_SKIP = 5
RESET_NOISE = 0.1
TOTAL_MASS = 14.0
WIND_ON = ("torso", "all_bodies", "rootx")


def _load_model() -> mujoco.MjModel:
    # MuJoCo 4 deprecates the file's `settotalmass` and warns into a file of the working directory at each load;
    # the call it stands for gives the same model to the last bit.
    model = mujoco.MjModel.from_xml_string(XML.read_text(encoding="utf-8").replace('settotalmass="14"', ""))
    mujoco.mj_setTotalmass(model, TOTAL_MASS)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


class HalfCheetahBody:
    """Dynamics alone: no reward, no context, no Gymnasium call.

    Args:
        wind_on: what the wind pushes: the `torso`, `all_bodies`, or the `rootx` joint (same effect as the torso).
    """

    def __init__(self, wind_on: str = "torso") -> None:
        if wind_on not in WIND_ON:
            raise ValueError(f"wind_on must be one of {', '.join(WIND_ON)}, not {wind_on!r}")
        self.wind_on = wind_on
        self.model = _load_model()
        self.data = mujoco.MjData(self.model)
        self.dt = self.model.opt.timestep * FRAME_SKIP
        # MuJoCo's bindings make a new view of their arrays at each look, and a search looks millions of times.
        self._position, self._velocity, self._control = self.data.qpos, self.data.qvel, self.data.ctrl
        self._forces = self.data.xfrc_applied
        self._rest = self.data.qpos.copy()
        self._torso = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, "torso")
        self._rootx = self.model.joint("rootx").dofadr[0]

    def reset(self, rng: np.random.Generator) -> None:
        """Stand near the rest pose with Gymnasium's reset noise and no wind."""
        mujoco.mj_resetData(self.model, self.data)
        self.blow(0.0)
        self.data.qpos[:] = self._rest + rng.uniform(-RESET_NOISE, RESET_NOISE, self.model.nq)
        self.data.qvel[:] = RESET_NOISE * rng.standard_normal(self.model.nv)
        mujoco.mj_forward(self.model, self.data)

    def blow(self, force: float) -> None:
        """Set a head wind of `force` N, held until the next call.

        A row of `xfrc_applied` is force, then torque: column 0 is the force along x. (Column 5, a torque about z,
        moves nothing in a planar body.)
        """
        if self.wind_on == "torso":
            self._forces[self._torso, 0] = -force
        elif self.wind_on == "all_bodies":
            self._forces[self._torso :, 0] = -force
        else:
            self.data.qfrc_applied[self._rootx] = -force

    def throw(self, speed: float) -> None:
        """Give it `speed` m/s along x, whatever it had; the limbs go on moving against the torso as they did."""
        self._velocity[self._rootx] = speed

    def step(self, action: np.ndarray, wind: float = 0.0) -> float:
        """Execute `action` (6,) for .05 s against `wind` N; returns the mean forward speed in m/s."""
        before = self.x
        self._control[:] = action
        self.blow(wind)
        mujoco.mj_step(self.model, self.data, nstep=FRAME_SKIP)
        return (self.x - before) / self.dt

    def observation(self) -> np.ndarray:
        """Positions without x, then velocities, shape (17,), float32."""
        return np.concatenate([self._position[1:], self._velocity]).astype(np.float32)

    @property
    def x(self) -> float:
        """Distance from the start, m."""
        return float(self._position[0])
