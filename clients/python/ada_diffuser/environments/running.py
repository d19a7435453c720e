"""What runs along a line: sessions, episodes and films of a body whose task hides something."""

from __future__ import annotations

from typing import Any, Protocol

import mujoco
import numpy as np
from gymnasium import spaces

from .task import HiddenTask

RENDER_SIZE = (480, 360)


class Body(Protocol):
    """Dynamics alone, stepped directly in MuJoCo; its model has a camera `track`."""

    model: mujoco.MjModel
    data: mujoco.MjData

    def reset(self, rng: np.random.Generator) -> None:
        """Stand near the rest pose."""
        ...

    def step(self, action: np.ndarray) -> float:
        """Execute an action, .05 s; returns the mean forward speed in m/s."""
        ...

    def observation(self) -> np.ndarray:
        """What it senses of itself, float32."""
        ...

    @property
    def x(self) -> float:
        """Distance from the start, m."""
        ...


class RunningTask(HiddenTask):
    """What the tasks of a body that runs share: episodes numbered within a session, clipped actions, rendering.

    A *session* starts at the first `reset` and at each `reset(seed=...)`; its episodes are numbered 0, 1, ...
    `reset(options={"episode": i})` jumps to episode `i`. The action is clipped to [-1, 1] before anything else.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (Gymnasium's own spelling)

    def __init__(self, body: Body, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array or None, not {render_mode!r}")
        self.body = body
        self.observation_space = spaces.Box(-np.inf, np.inf, body.observation().shape, np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (body.model.nu,), np.float32)
        self.render_mode = render_mode
        self._renderer: mujoco.Renderer | None = None
        self._episode = -1
        self._step = 0

    @property
    def context(self) -> np.ndarray:
        """The hidden value that acts on the coming step, shape (1,)."""
        return np.array([self._context()], np.float32)

    def coming_context(self, steps: int) -> np.ndarray:
        """See `HiddenTask`."""
        return np.array(self._coming(steps), np.float32)[:, None]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see the class for `seed` and `options`."""
        super().reset(seed=seed)
        starts_session = seed is not None or self._episode < 0
        self._episode = 0 if starts_session else self._episode + 1
        self._episode = int((options or {}).get("episode", self._episode))
        self._step = 0
        self._draw_context(starts_session)
        self.body.reset(self.np_random)
        return self.body.observation(), {"context": self.context, "x_position": self.body.x}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance .05 s; see `gymnasium.Env.step`."""
        action = np.minimum(np.maximum(np.asarray(action, np.float64), -1.0), 1.0)  # np.clip, at a third of its time
        context = self.context
        speed = self._move(action)
        reward = self._reward(speed, action)
        self._step += 1
        info = {"context": context, "x_position": self.body.x, "x_velocity": speed}
        return self.body.observation(), reward, False, False, info

    def render(self) -> np.ndarray | None:
        """One frame (360, 480, 3) uint8 from the camera that tracks the body; needs a working `MUJOCO_GL`."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self.body.model, height=RENDER_SIZE[1], width=RENDER_SIZE[0])
        self._renderer.update_scene(self.body.data, camera="track")
        return self._renderer.render()

    def close(self) -> None:
        """Free the renderer, if one was made."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _draw_context(self, starts_session: bool) -> None:
        raise NotImplementedError

    def _context(self) -> float:
        raise NotImplementedError

    def _coming(self, steps: int) -> list[float]:
        """`_context` of so many steps from now on; it stays as it is, unless a task says another."""
        return [self._context()] * steps

    def _move(self, action: np.ndarray) -> float:
        """Make the step; returns the speed in m/s."""
        return self.body.step(action)

    def _reward(self, speed: float, action: np.ndarray) -> float:
        """Of the step that was just made, at `speed` m/s by the clipped `action`."""
        raise NotImplementedError
