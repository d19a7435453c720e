"""Kitchen: a robot arm that should do four things in a kitchen, as in D4RL, on gymnasium-robotics' FrankaKitchen-v1."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import mujoco
import numpy as np
from gymnasium import spaces

from .kitchen_body import ROBOT, KitchenBody
from .kitchen_pilot import SCRIPTS, Pilot
from .task import References, Task

GOALS: dict[str, dict[int, float]] = {
    "bottom burner": {11: -0.88, 12: -0.01},
    "light switch": {17: -0.69, 18: -0.05},
    "slide cabinet": {19: 0.37},
    "microwave": {22: -0.75},
    "kettle": dict(zip(range(23, 30), (-0.23, 0.75, 1.62, 0.99, 0.0, 0.0, -0.06), strict=True)),
}
"""Subtask -> position in MuJoCo's order of joints -> where it should be."""
DONE = 0.3
"""Distance from its goal within which a subtask is done."""
RENDER_SIZE = (480, 360)


class Kitchen(Task):
    """Four subtasks in any order; what counts is how many are done.

        r = how many of the four were done in this step for the first time       280 steps of .08 s, fewer where all are done

    The 59 numbers observed are FrankaKitchen-v1's: positions and velocities of the robot's nine joints, then positions and velocities of
    the things. An action is the nine joints' speeds, [-1, 1] for up to 2 rad/s, clipped to its box before anything else. A subtask is done
    where its joints are within .3 of their goals. All episodes begin alike, but for the noise of what is observed. The goal is a vector of
    where the things' joints should be, the same in every episode.

    Args:
        render_mode: `rgb_array` or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 12}  # noqa: RUF012 (Gymnasium's own spelling)
    episode_steps = 280
    action_noise = (0.0, 0.05, 0.1)
    references = References(random=0.0, expert=4.0)
    subtasks: ClassVar[tuple[str, ...]]
    """Those that count."""
    shows_all: ClassVar[bool]
    """Whether some of its demonstrations do all that counts."""

    def __init_subclass__(cls, **words: Any) -> None:
        cls.goal_columns = tuple(place + ROBOT for subtask in cls.subtasks for place in GOALS[subtask])
        super().__init_subclass__(**words)

    def __init__(self, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array or None, not {render_mode!r}")
        self.body, self.render_mode = KitchenBody(), render_mode
        size = 2 * ROBOT + self.body.model.nq + self.body.model.nv - 2 * ROBOT
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (ROBOT,), np.float32)
        self.done: list[str] = []
        """Subtasks that were done in this episode, in order."""
        self._renderer: mujoco.Renderer | None = None

    @property
    def goal(self) -> np.ndarray:
        """Where the things' joints should be, in the order of `goal_columns`."""
        return np.array([value for subtask in self.subtasks for value in GOALS[subtask].values()], np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see `gymnasium.Env.reset`."""
        super().reset(seed=seed)
        self.done = []
        return self.body.reset(self.np_random).astype(np.float32), {"done": []}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance .08 s; see `gymnasium.Env.step`."""
        observation = self.body.step(np.asarray(action, np.float64), self.np_random)
        fresh = [one for one in self.subtasks if one not in self.done and self.distance(one, observation) < DONE]
        self.done += fresh
        ended = len(self.done) == len(self.subtasks)
        return observation.astype(np.float32), float(len(fresh)), ended, False, {"done": list(self.done)}

    @staticmethod
    def distance(subtask: str, observation: np.ndarray) -> float:
        """How far the joints of a subtask are from their goals, of an observation (59,)."""
        goal = GOALS[subtask]
        return float(np.linalg.norm(observation[np.array(list(goal)) + ROBOT] - np.array(list(goal.values()))))

    def expert_plan(self, rng: np.random.Generator) -> Callable[..., np.ndarray]:
        """four of the five subtasks there are scripts for, in a drawn order: poses beside the things, by inverse kinematics

        `mixed` never draws all those that count: whoever imitates has to put together what no demonstration shows.
        """
        pilot = Pilot(self.body.model, self.drawn_order(rng), self.distance)
        return lambda observation, goal: pilot.act(observation)

    def drawn_order(self, rng: np.random.Generator) -> list[str]:
        """Subtasks of a demonstration, as many as count, in order."""
        while True:
            order = [str(one) for one in rng.permutation(list(SCRIPTS))[: len(self.subtasks)]]
            if self.shows_all or set(order) != set(self.subtasks):
                return order

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode did nothing that counts."""
        return episode_return == 0.0

    def measures(self, episode_return: float) -> dict[str, float]:
        """The score, and how many subtasks were done."""
        return {**super().measures(episode_return), "subtasks": episode_return}

    def render(self) -> np.ndarray | None:
        """One frame (360, 480, 3) uint8 from behind the robot's shoulder; needs a working `MUJOCO_GL`."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self.body.model, height=RENDER_SIZE[1], width=RENDER_SIZE[0])
        camera = mujoco.MjvCamera()
        camera.distance, camera.azimuth, camera.elevation = 2.2, 70.0, -35.0
        camera.lookat[:] = (-0.2, 0.5, 2.0)
        self._renderer.update_scene(self.body.data, camera=camera)
        return self._renderer.render()

    def close(self) -> None:
        """Free the renderer, if one was made."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


class KitchenMixed(Kitchen, name="kitchen-mixed", id="ada/KitchenMixed-v0"):
    """Microwave, kettle, bottom burner and light switch; no demonstration does all four."""

    subtasks, shows_all = ("microwave", "kettle", "bottom burner", "light switch"), False


class KitchenPartial(Kitchen, name="kitchen-partial", id="ada/KitchenPartial-v0"):
    """Microwave, kettle, light switch and slide cabinet; about one demonstration in five does all four."""

    subtasks, shows_all = ("microwave", "kettle", "light switch", "slide cabinet"), True
