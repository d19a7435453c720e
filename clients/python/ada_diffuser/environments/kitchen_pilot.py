"""Who does the kitchen's subtasks: a script of poses beside the things, and inverse kinematics that goes from one to the next."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from .kitchen_body import JOINTS_HIGH, JOINTS_LOW, ROBOT, SPEED, START

ARM = 7
STEP = 0.08
"""Of the environment, s."""
OPEN, CLOSE = 1.0, -1.0
"""Actions of both fingers."""
GAIN, TURN_GAIN = 8.0, 5.0
"""Speed of the hand for a metre of distance, and for a radian, 1/s."""
HAND_SPEED = 1.2
"""At most, m/s."""
DAMPING = 0.003
"""Of the inverse: how little the hand's speed is worth where the arm is stretched."""
MIDDLE = np.array([0.0, 0.0, 0.8, -1.75, 0.0, 1.2, 0.8])
"""Joints of the arm, to which it is drawn so far as the hand does not mind."""
MARGIN = 0.05
"""From the end of a joint, where it is not driven any further, rad."""
LOW, HIGH = JOINTS_LOW[:ARM] + MARGIN, np.minimum(JOINTS_HIGH[:ARM], [2.9, 1.76, 2.9, -0.4, 2.9, 2.11, 2.9]) - MARGIN
STEERING = 0.2
"""To the side, m, for each radian that a thing has turned."""
LATCHED, MISSED = 0.28, 0.3
"""Distances of a subtask from its goal: within the first the pilot leaves it, from the second on, where nothing counts, it tries again."""


@dataclass(frozen=True)
class Pose:
    """Where the hand should be.

    Attributes:
        offset: from the thing's site as the subtask begins, m, x to the right, y away from the robot, z up.
        fingers: `OPEN` or `CLOSE`.
        near: distance within which it counts as reached, m; 0: it is held for all of its steps.
        steps: after which the pilot goes on in any case.
        turn: of the hand: how far it points down, to the left, and is rolled about where it points, rad.
        works: whether it ends as soon as the subtask is done.
        steers: whether the hand stays behind the middle of the thing, wherever that goes, and to the side that turns it back.
    """

    offset: tuple[float, float, float]
    fingers: float
    near: float = 0.03
    steps: int = 25
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    works: bool = False
    steers: bool = False


@dataclass(frozen=True)
class Script:
    """How a subtask is done: the site of the thing, and poses one after the other."""

    site: str
    poses: tuple[Pose, ...]


HOOKED, DOWN = (0.4, 0.3, 0.0), (0.7, 0.0, 0.0)
SCRIPTS = {
    "microwave": Script(
        "microhandle_site",
        (
            Pose((0.08, -0.24, 0.08), OPEN, 0.06, turn=HOOKED),
            Pose((0.035, -0.11, 0.045), OPEN, 0.015, 20, HOOKED),
            Pose((0.0, 0.01, 0.0), OPEN, 0.015, 20, HOOKED),
            Pose((0.0, 0.01, 0.0), CLOSE, 0.0, 4, HOOKED),
            Pose((-0.06, -0.19, 0.0), CLOSE, 0.05, 15, HOOKED, works=True),
            Pose((-0.18, -0.38, 0.0), CLOSE, 0.02, 20, HOOKED, works=True),
            Pose((-0.14, -0.36, 0.0), OPEN, 0.0, 3, HOOKED),
        ),
    ),
    "kettle": Script(
        "kettle_site",
        (
            Pose((0.0, -0.25, 0.08), OPEN, 0.06, turn=DOWN),
            Pose((0.0, -0.20, -0.15), OPEN, 0.03, turn=DOWN),
            Pose((0.0, -0.02, -0.15), OPEN, 0.03, 20, DOWN),
            Pose((0.0, 0.22, -0.15), OPEN, 0.03, 40, DOWN, works=True, steers=True),
        ),
    ),
    "bottom burner": Script(
        "knob2_site",
        (
            Pose((0.0, -0.12, 0.0), OPEN, 0.025, 25),
            Pose((0.0, 0.02, 0.0), OPEN, 0.012, 20),
            Pose((0.0, 0.02, 0.0), CLOSE, 0.0, 4),
            Pose((0.0, 0.02, 0.0), CLOSE, 0.0, 25, (0.0, 0.0, 1.4), works=True),
            Pose((0.0, -0.06, 0.0), OPEN, 0.03, 6),
        ),
    ),
    "light switch": Script(
        "light_site",
        (
            Pose((0.07, -0.17, 0.0), CLOSE, 0.05),
            Pose((0.06, -0.016, 0.0), CLOSE, 0.02, 20),
            Pose((-0.11, -0.016, 0.0), CLOSE, 0.02, 25, works=True),
        ),
    ),
    "slide cabinet": Script(
        "slide_site",
        (
            Pose((-0.14, -0.16, -0.15), CLOSE, 0.06),
            Pose((-0.09, -0.007, 0.0), CLOSE, 0.03, 25),
            Pose((0.43, -0.007, 0.0), CLOSE, 0.02, 40, works=True),
        ),
    ),
}
"""By subtask."""
TRIES = 2
"""Of a script, where the subtask is not done after the first."""
BACK_Y, BACK_STEPS = 0.36, 8
"""How far the hand goes back after each try, and for how long at most."""
HOME, HOME_GAIN, HOME_NEAR, HOME_STEPS = START[:ARM], 5.0, 0.25, 20
"""Then the joints go to where an episode begins, at so many 1/s, to so many rad, for so many steps at most: from elsewhere the arm would
come to a thing bent in another way, and find its joints at their ends."""


class Pilot:
    """Does subtasks in an order, then holds still; for one episode. It sees what is observed and nothing more.

    Args:
        model: of the kitchen.
        order: subtasks, names of `SCRIPTS`.
        distance: how far a subtask is from done, of an observation.
    """

    def __init__(self, model: mujoco.MjModel, order: Sequence[str], distance: Callable[[str, np.ndarray], float]) -> None:
        self._model, self._kinematics, self._distance = model, mujoco.MjData(model), distance
        self._hand = model.site("end_effector").id
        self._gain = model.actuator_gainprm[:ARM, 0]
        self._seen = np.zeros(0)
        self._actions = self._run(order)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Action (9,) for an observation (59,), the next of the episode."""
        self._seen = np.asarray(observation, np.float64)
        data = self._kinematics
        data.qpos[:ROBOT], data.qpos[ROBOT:] = self._seen[:ROBOT], self._seen[2 * ROBOT :][: self._model.nq - ROBOT]
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        return next(self._actions)

    def _run(self, order: Sequence[str]) -> Iterator[np.ndarray]:
        """The actions, each of the observation that is there when it is asked for."""
        for subtask in order:
            for _ in range(TRIES):
                yield from self._try(subtask)
                if self._distance(subtask, self._seen) < MISSED:
                    break
        place, turn = self._kinematics.site_xpos[self._hand].copy(), self._kinematics.site_xmat[self._hand].reshape(3, 3).copy()
        while True:
            yield self._towards(place, turn, CLOSE)

    def _try(self, subtask: str) -> Iterator[np.ndarray]:
        script = SCRIPTS[subtask]
        origin = self._kinematics.site_xpos[self._model.site(script.site).id].copy()
        for pose in script.poses:
            yield from self._go(origin, pose, subtask)
        behind = self._kinematics.site_xpos[self._hand].copy()
        behind[1] = min(behind[1], BACK_Y)
        yield from self._go(behind, Pose((0.0, 0.0, 0.0), script.poses[-1].fingers, 0.08, BACK_STEPS), subtask)
        for _ in range(HOME_STEPS):
            left = HOME - self._seen[:ARM]
            if np.abs(left).max() < HOME_NEAR:
                return
            yield self._driven(HOME_GAIN * left, CLOSE)

    def _go(self, origin: np.ndarray, pose: Pose, subtask: str) -> Iterator[np.ndarray]:
        place, turn = origin + pose.offset, _turned(*pose.turn)
        thing = self._model.site(SCRIPTS[subtask].site).id
        for _ in range(pose.steps):
            if pose.steers:
                frame = self._kinematics.site_xmat[thing]
                place[0] = self._kinematics.site_xpos[thing][0] - STEERING * np.arctan2(frame[3], frame[0])
            if pose.works and self._distance(subtask, self._seen) < LATCHED:
                return
            if np.linalg.norm(place - self._kinematics.site_xpos[self._hand]) < pose.near:
                return
            yield self._towards(place, turn, pose.fingers)

    def _towards(self, place: np.ndarray, turn: np.ndarray, fingers: float) -> np.ndarray:
        """Action that brings the hand nearer to a place (3,) and a turn (3, 3).

        The hand's speed goes to the joints by the damped inverse of its Jacobian; a joint at its end takes no part, and what is left
        free draws to the middle.
        """
        model, data = self._model, self._kinematics
        jacobian = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], self._hand)
        frame = data.site_xmat[self._hand].reshape(3, 3)
        wish = np.concatenate(
            [
                _at_most(GAIN * (place - data.site_xpos[self._hand]), HAND_SPEED),
                TURN_GAIN / 2 * np.cross(frame, turn, axis=0).sum(axis=1),
            ]
        )
        return self._driven(_joint_speeds(jacobian[:, :ARM], wish, self._seen[:ARM]), fingers)

    def _driven(self, speeds: np.ndarray, fingers: float) -> np.ndarray:
        """Action for speeds of the arm's joints (7,), rad/s, or as much of them as it can.

        As the arm sinks under its weight from where each step sends it, that much is added.
        """
        weight = np.zeros(self._model.nv)
        mujoco.mj_rne(self._model, self._kinematics, 0, weight)
        sinking = weight[:ARM] / self._gain / (SPEED * STEP)
        arm = speeds / SPEED
        arm *= min(1.0, 0.95 / max(1e-9, float(np.abs(arm).max())))
        return np.clip(np.concatenate([arm + sinking, [fingers, fingers]]), -1.0, 1.0)


def _joint_speeds(jacobian: np.ndarray, wish: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Of the arm (7,), rad/s, for the hand's wished speed (6,)."""
    free = np.ones(ARM, bool)
    for _ in range(ARM):
        moves = jacobian * free
        inverse = moves.T @ np.linalg.inv(moves @ moves.T + DAMPING * np.eye(6))
        speeds = free * (inverse @ wish + (np.eye(ARM) - inverse @ moves) @ (MIDDLE - joints))
        beyond = free & (((joints <= LOW) & (speeds < 0)) | ((joints >= HIGH) & (speeds > 0)))
        if not beyond.any():
            break
        free &= ~beyond
    return speeds


def _turned(down: float, left: float, roll: float) -> np.ndarray:
    """The hand's frame (3, 3): its third column is where it points, the second along which its fingers open."""
    points = np.array([-np.sin(left) * np.cos(down), np.cos(left) * np.cos(down), -np.sin(down)])
    opens = np.array([np.cos(left), np.sin(left), 0.0])
    frame = np.stack([np.cross(opens, points), opens, points], axis=1)
    c, s = np.cos(roll), np.sin(roll)
    return frame @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _at_most(vector: np.ndarray, length: float) -> np.ndarray:
    return vector * min(1.0, length / max(1e-9, float(np.linalg.norm(vector))))
