"""Maze2D: a point mass that should go through a maze to a goal, as in D4RL, on gymnasium-robotics' PointMaze."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from .extra import robotics
from .task import References, Task

GOAL_RADIUS = 0.5
"""Cells from the goal within which a step earns 1."""
GAIN, DRAG = 4.0, 1.0
"""Of the pilot: thrust for a cell of distance to its waypoint, and against a speed of one cell a second."""
CELL_PIXELS = 40
TRAIL_STEPS = 400

Cell = tuple[int, int]
"""Row and column, from the upper left."""


class Maze2d(Task):
    """A ball of 2 degrees of freedom in a maze of cells 1 m wide; nothing but the goal is hidden, and a model can be told that.

        r = 1 where |p' - goal| <= .5, else 0       observation (p, v) in R^4, m and m/s, (0, 0) the middle of the maze, y upwards

    The action in [-1, 1]^2 is a force, clipped to its box before anything else; a step is .01 s, and no speed along an axis is above 5 m/s.
    Start and goal are drawn in each episode: two cells that are not walls, and up to .25 m in x and y from their middles. An episode never
    ends before its last step, so an early arrival earns more.

    D4RL's references are those of its fixed goals (cell (1, 1) of the small maze, (6, 6) and (7, 9) of the others), and goals that are
    drawn may be farther or nearer: its scale, as it is used for drawn goals elsewhere too, and no more.

    Args:
        reset_target: whether another goal is drawn where one is reached. For data that go everywhere, as D4RL's do; a model is told the
            first goal alone.
        render_mode: `rgb_array` or None.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012 (Gymnasium's own spelling)
    action_noise = (0.0, 0.2, 0.4)
    goal_columns = (0, 1)
    layout: ClassVar[str]
    """Of gymnasium-robotics' maps."""

    def __init__(self, reset_target: bool = False, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array or None, not {render_mode!r}")
        maze = robotics("envs.maze.point_maze")
        walls = getattr(robotics("envs.maze.maps"), self.layout)
        self._maze = maze.PointMazeEnv(walls, continuing_task=True, reset_target=reset_target)
        Path(self._maze.tmp_xml_file_path).unlink(missing_ok=True)  # which nobody else removes
        self.walls = np.array(walls) == 1
        """Which cells are, (rows, columns)."""
        self.reset_target, self.render_mode = reset_target, render_mode
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._ways: dict[Cell, dict[Cell, Cell]] = {}
        self._trail: deque[np.ndarray] = deque(maxlen=TRAIL_STEPS)
        self._goal: np.ndarray | None = None

    @property
    def goal(self) -> np.ndarray | None:
        """Where it should go, (2,), m; None before the first episode."""
        return self._goal

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; `options` are PointMaze's (`goal_cell`, `reset_cell`)."""
        super().reset(seed=seed)
        seen, _ = self._maze.reset(seed=seed, options=options or None)
        self._trail.clear()
        return self._observed(seen), {"success": self._reached(seen)}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advance .01 s; see `gymnasium.Env.step`."""
        wanted = self._maze.goal.copy()
        seen, *_ = self._maze.step(np.clip(np.asarray(action, np.float64), -1.0, 1.0))
        reached = self._reached(seen, wanted)
        return self._observed(seen), float(reached), False, False, {"success": reached}

    def expert_action(self, observation: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """clip(4 (w - p) - v), w the middle of the next cell on the shortest way to the goal's, or the goal where that is its own cell"""
        position, velocity = observation[:2].astype(np.float64), observation[2:].astype(np.float64)
        here, there = self.cell(position), self.cell(goal)
        waypoint = np.asarray(goal, np.float64) if here == there else self.middle(self._way_to(there)[here])
        return np.clip(GAIN * (waypoint - position) - DRAG * velocity, -1.0, 1.0)

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode never came near its goal."""
        return episode_return == 0.0

    def measures(self, episode_return: float) -> dict[str, float]:
        """The score, and whether the goal was reached (`success`, whose mean is the success rate)."""
        return {**super().measures(episode_return), "success": float(not self.failed(episode_return))}

    def cell(self, position: np.ndarray) -> Cell:
        """In which a position (2,) is."""
        rows, columns = self.walls.shape
        return int(np.floor(rows / 2 - position[1])), int(np.floor(position[0] + columns / 2))

    def middle(self, cell: Cell) -> np.ndarray:
        """Of a cell, (2,), m."""
        rows, columns = self.walls.shape
        return np.array([cell[1] + 0.5 - columns / 2, rows / 2 - cell[0] - 0.5])

    def _way_to(self, there: Cell) -> dict[Cell, Cell]:
        """The next cell of every other one on a shortest way to this one, by a search in breadth from there."""
        if there not in self._ways:
            way, border = {there: there}, deque([there])
            while border:
                reached = border.popleft()
                for cell in self._beside(reached):
                    if cell not in way:
                        way[cell] = reached
                        border.append(cell)
            self._ways[there] = way
        return self._ways[there]

    def _beside(self, cell: Cell) -> Iterable[Cell]:
        row, column = cell
        around = ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1))
        return [place for place in around if not self.walls[place]]

    def _observed(self, seen: dict[str, np.ndarray]) -> np.ndarray:
        observation = seen["observation"].astype(np.float32)
        self._goal = self._maze.goal.astype(np.float32)
        self._trail.append(observation[:2])
        return observation

    def _reached(self, seen: dict[str, np.ndarray], goal: np.ndarray | None = None) -> bool:
        goal = self._maze.goal if goal is None else goal
        return bool(np.linalg.norm(seen["observation"][:2] - goal) <= GOAL_RADIUS)

    def render(self) -> np.ndarray | None:
        """One frame from above, uint8: walls, the goal with the ring in which a step earns 1, and the ball with its trail."""
        if self.render_mode is None:
            return None
        from PIL import Image, ImageDraw

        rows, columns = self.walls.shape
        frame = Image.fromarray(np.where(self.walls, 120, 255).astype(np.uint8)).convert("RGB")
        frame = frame.resize((columns * CELL_PIXELS, rows * CELL_PIXELS), Image.Resampling.NEAREST)
        draw = ImageDraw.Draw(frame)
        if self._goal is not None:
            x, y = self._pixel(self._goal)
            for radius, colour in ((GOAL_RADIUS * CELL_PIXELS, (240, 200, 190)), (5, (200, 60, 40))):
                draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=colour, width=2)
        trail = [self._pixel(past) for past in self._trail]
        if len(trail) > 1:
            draw.line(trail, fill=(160, 190, 230), width=3)
        if trail:
            x, y = trail[-1]
            draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=(30, 90, 180))
        return np.asarray(frame)

    def draw_ways(self, axes: Any, ways: Iterable[tuple[np.ndarray, np.ndarray | None]], colour: str) -> None:
        """See `Task`."""
        rows, columns = self.walls.shape
        axes.imshow(self.walls, extent=(-columns / 2, columns / 2, -rows / 2, rows / 2), cmap="Greys", vmin=0, vmax=2)
        for states, goal in ways:
            axes.plot(states[:, 0], states[:, 1], color=colour, linewidth=1)
            axes.plot(*states[0, :2], "o", color=colour, markersize=3)
            if goal is not None:
                axes.plot(*goal, "*", color="C3", markersize=8)
        axes.set(xlabel="x, m", ylabel="y, m")

    def close(self) -> None:
        """Free the simulator."""
        self._maze.close()

    def _pixel(self, position: np.ndarray) -> tuple[float, float]:
        rows, columns = self.walls.shape
        return (float(position[0]) + columns / 2) * CELL_PIXELS, (rows / 2 - float(position[1])) * CELL_PIXELS


class Maze2dUmaze(Maze2d, name="maze2d-umaze", id="ada/Maze2D-UMaze-v0"):
    """`Maze2d` in the maze of 7 cells in a U."""

    layout, episode_steps = "U_MAZE", 300
    references = References(random=23.85, expert=161.86)


class Maze2dMedium(Maze2d, name="maze2d-medium", id="ada/Maze2D-Medium-v0"):
    """`Maze2d` in the maze of 6 by 6 cells."""

    layout, episode_steps = "MEDIUM_MAZE", 600
    references = References(random=13.13, expert=277.39)


class Maze2dLarge(Maze2d, name="maze2d-large", id="ada/Maze2D-Large-v0"):
    """`Maze2d` in the maze of 7 by 10 cells."""

    layout, episode_steps = "LARGE_MAZE", 800
    references = References(random=6.7, expert=273.99)
