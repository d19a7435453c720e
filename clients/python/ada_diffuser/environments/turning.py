"""A cheetah and an ant that should run forward and backward in turn, and that nobody tells which."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from .ant import AntBody
from .half_cheetah import HalfCheetahBody
from .running import Body, RunningTask
from .search import Search

ACTION_COST = 0.1
PERIOD = 200
"""Steps: 100 one way, 100 the other."""
SHARPNESS = 5.0
WAVES = ("signed", "unsigned")
THROWN_EVERY = 100
THROWN = 5.0
"""Speed at most, m/s: what the gaits reach."""

# The ant's legs in the order of its joints: front left, front right (as Gymnasium calls them), back, right back.
SWINGS = np.array([[-1, 1], [-1, -1], [1, -1], [1, 1]]) / math.sqrt(2)
"""Where the foot goes, in the torso's x and y, when the hip's angle grows."""
DOWN = np.array([1, -1, -1, 1])
"""Sign by which the ankle's angle grows when the foot goes down."""
TROT = np.array([1, -1, 1, -1])
ACTUATED = [3, 0, 1, 2]
"""Legs in the order of the actions."""


class DirectionTask(RunningTask):
    """What the two share: reward `d v - .1 a.a`, where the direction `d_t` turns within the episode and shows in the reward alone.

    `d_t = 2 sigmoid(5 sin(2 pi t / 200 + phi)) - 1` lies between -1 and 1, as much of it each way in an episode, its period; half of the
    time beyond .94.
    """

    failed_return: ClassVar[float]
    """Below this an episode counts as failed; standing still earns 0."""

    def __init__(self, body: Body, directions: str, phase: float | None, render_mode: str | None) -> None:
        if directions not in WAVES:
            raise ValueError(f"directions must be one of {', '.join(WAVES)}, not {directions!r}")
        super().__init__(body, render_mode)
        self.directions, self.phase = directions, phase
        self._phi = 0.0

    def failed(self, episode_return: float) -> bool:
        """Whether a finished episode earned little more than standing still would have."""
        return episode_return < self.failed_return

    def _draw_context(self, starts_session: bool) -> None:
        drawn = self.np_random.uniform(0.0, 2.0 * math.pi)
        self._phi = drawn if self.phase is None else self.phase

    def _context(self) -> float:
        return self._direction(self._step)

    def _coming(self, steps: int) -> list[float]:
        return [self._direction(self._step + ahead) for ahead in range(steps)]

    def _direction(self, step: int) -> float:
        share = 1.0 / (1.0 + math.exp(-SHARPNESS * math.sin(2.0 * math.pi * step / PERIOD + self._phi)))
        return 2.0 * share - 1.0 if self.directions == "signed" else share

    def _reward(self, speed: float, action: np.ndarray) -> float:
        return self._context() * speed - ACTION_COST * float(action @ action)


class CheetahDirE(DirectionTask, name="cheetah-dir-e", id="ada/CheetahDir-E-v0"):
    """The half cheetah, which should run forward where `d > 0` and backward where `d < 0`.

        r_t = d_t v_t - .1 a.a        d_t = 2 sigmoid(5 sin(2 pi t / 200 + phi)) - 1

    The expert has a gait for each way, and changes it in the step in which the sign of `d` changes. On this ground nobody stops from 5
    m/s in less than 25 steps. It is called `-E`, as in the paper, though `d` varies with the step.

    What the direction is worth to know, 64 episodes from seed 1000:

        gait                                     mean return    failed
        the expert's, that of the direction       262 ± 11       2
        the expert's for forward, always          -82 ± 12      60
        a blind one searched for: it stands         0 ±  0      64

    Gaits that were searched for from rest, without drills, run faster, fall when they are to turn round, and earn 172 ± 17 (24 episodes).

    Args:
        directions: `signed` (default), or `unsigned` for `d_t = sigmoid(...)` as the paper prints it, which never asks to run backward.
        phase: `phi`, or None to draw it in each episode; 0 is the paper's.
        render_mode: `rgb_array` or None.
        drills: what the gaits are searched for in, in place of the wave: directions, of which an episode draws one and holds it, while in
            steps 0 and 100 the cheetah is thrown the wrong way, at up to 5 m/s, as it runs when the direction has just turned.
    """

    action_noise = (0.0, 0.05, 0.1)  # more of it stops the gait
    search = Search(holds="drills", searches=1)
    failed_return = 50.0
    body: HalfCheetahBody

    def __init__(
        self, directions: str = "signed", phase: float | None = None, render_mode: str | None = None, drills: Sequence[float] = ()
    ) -> None:
        if isinstance(drills, str) or not all(math.isfinite(value) and value for value in drills):
            raise ValueError(f"drills must be numbers other than 0, not {drills!r}")
        super().__init__(HalfCheetahBody(), directions, phase, render_mode)
        self.drills = tuple(float(value) for value in drills)
        self._drilled = 0.0

    @property
    def search_targets(self) -> tuple[float, ...]:
        """One policy a direction."""
        if self.drills:
            return tuple(sorted(set(self.drills)))
        return (-1.0, 1.0) if self.directions == "signed" else (1.0,)

    def _draw_context(self, starts_session: bool) -> None:
        super()._draw_context(starts_session)
        if self.drills:
            self._drilled = self.drills[self.np_random.integers(len(self.drills))]

    def _direction(self, step: int) -> float:
        return self._drilled if self.drills else super()._direction(step)

    def _move(self, action: np.ndarray) -> float:
        if self.drills and self._step % THROWN_EVERY == 0:
            self.body.throw(-math.copysign(self.np_random.uniform(0.0, THROWN), self._drilled))
        return self.body.step(action)


class AntDirE(DirectionTask, name="ant-dir-e", id="ada/AntDir-E-v0"):
    """Gymnasium's Ant-v5, which should run along x where `d > 0` and against it where `d < 0`. No fall ends the episode. It is
    called `-E`, as in the paper, though `d` varies with the step.

        r_t = d_t v_t - .1 a.a        d_t = 2 sigmoid(5 sin(2 pi t / 200 + phi)) - 1        v_t the torso's speed along x, m/s

    What the direction is worth to know, 64 episodes from seed 1000:

        the expert                     mean return    failed
        is told the direction           148 ± 4        2
        takes it for forward, always    -14 ± 5       61
        takes it for none, and stands     0 ± 0       64

    The numbers in its law were searched for at random, some minutes on one core. Augmented Random Search over linear policies found no gait
    in the four minutes that it was given: 17 at best.

    The 27 numbers observed are the torso's height and orientation, the joints' angles, and the speeds of all these. Ant-v5's 78
    contact forces are left out (the paper has them): clipped to 1, they mostly say what touches the ground, and a planner would have to
    draw all of them.

    Args:
        directions: `signed` (default), or `unsigned` for `d_t = sigmoid(...)`.
        phase: `phi`, or None to draw it in each episode; 0 is the paper's.
        render_mode: `rgb_array` or None.
    """

    action_noise = (0.0, 0.05, 0.1)
    failed_return = 30.0

    def __init__(self, directions: str = "signed", phase: float | None = None, render_mode: str | None = None) -> None:
        super().__init__(AntBody(), directions, phase, render_mode)

    def expert_action(self, observation: np.ndarray, context: np.ndarray) -> np.ndarray:
        """hip = -c m(1.1 clip(q, .4) + .25 clip(q', 3)) - .08 h - .04 h', ankle = m(.5 c h) - .08 q - .04 q'

        For each leg: `h` is its hip's angle, `q` how far its ankle is bent down beyond the middle, and `c` in [-1, 1] how much of a turn of
        the hip is along the wanted way, wherever the torso looks, times clip(3 d, 1). So a foot that is down is drawn back, then lifted,
        swung forward, and put down; where `d < 0` it goes round the other way. `m(x) = .7 x + .3 s mean(s x)` with `s = (1, -1, 1, -1)`
        has the legs trot.
        """
        w, x, y, z = (float(value) for value in observation[1:5])
        yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
        along = SWINGS @ (math.cos(yaw), -math.sin(yaw)) * min(max(3.0 * float(context[0]), -1.0), 1.0)
        hip, hip_speed = observation[5:13:2].astype(np.float64), observation[19:27:2]
        foot, foot_speed = DOWN * observation[6:13:2] - 0.84, DOWN * observation[20:27:2]
        back = _trotting(1.1 * np.clip(foot, -0.4, 0.4) + 0.25 * np.clip(foot_speed, -3.0, 3.0))
        hips = -along * back - 0.08 * hip - 0.04 * hip_speed
        ankles = _trotting(0.5 * along * hip) - 0.08 * foot - 0.04 * foot_speed
        return np.stack([hips, DOWN * ankles], axis=1)[ACTUATED].ravel()

    @property
    def mean_context(self) -> np.ndarray:
        """No direction: it is as often one as the other."""
        return np.zeros(1, np.float32)


def _trotting(legs: np.ndarray) -> np.ndarray:
    """Each leg's number (4,) drawn towards one by which neighbours do the opposite."""
    return 0.7 * legs + 0.3 * TROT * (TROT @ legs) / 4.0
