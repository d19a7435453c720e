"""Environments, most of them with a hidden context; importing this module registers them with Gymnasium.

    import gymnasium
    env = gymnasium.make("ada_diffuser.environments:ada/PointWind-S-v0")

`-S` contexts change within an episode, `-E` contexts between episodes, but for those of the paper's Dir-E, which change within. The
context is in `info["context"]` alone: the array returned by step `t` acted while `a_t` was executed, the one returned by `reset` acts on
the first step. Those that hide nothing, Walker2d, Maze2D and Kitchen, tell none.
"""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import load_env_creator

from .cheetah import CheetahVelE, CheetahWindE, CheetahWindS
from .cheetah_switching import CheetahCumulativeS, CheetahDelayedS, CheetahGaleS
from .kitchen import KitchenMixed, KitchenPartial
from .legged import HopperGravityE, WalkerMassE
from .maze import Maze2dLarge, Maze2dMedium, Maze2dUmaze
from .pendulum import PendulumGravityE
from .pendulum_torque import PendulumTorqueS
from .point_wind import PointWindS
from .search import ArsSettings, Search
from .task import NAMES, HiddenTask, References, Task
from .turning import AntDirE, CheetahDirE
from .walker import Walker2d

__all__ = [
    "NAMES",
    "AntDirE",
    "ArsSettings",
    "CheetahCumulativeS",
    "CheetahDelayedS",
    "CheetahDirE",
    "CheetahGaleS",
    "CheetahVelE",
    "CheetahWindE",
    "CheetahWindS",
    "HiddenTask",
    "HopperGravityE",
    "KitchenMixed",
    "KitchenPartial",
    "Maze2dLarge",
    "Maze2dMedium",
    "Maze2dUmaze",
    "PendulumGravityE",
    "PendulumTorqueS",
    "PointWindS",
    "References",
    "Search",
    "Task",
    "Walker2d",
    "WalkerMassE",
    "action_noise",
    "failed",
    "goal",
    "hidden",
    "make",
    "measures",
    "steps_max",
]


def make(name: str, *, episode_steps: int | None = None, **options: Any) -> gym.Env:
    """Make an environment by short name, Gymnasium id, or `MODULE:ID`, where the module is imported first.

    `episode_steps` truncates episodes there, and not where the environment was registered to be. Observations and actions must
    be vectors (a `Box` of one dimension), of any length. Raises `ValueError` with the choices or the reason.
    """
    module, _, env_id = name.rpartition(":")
    if module:
        _import(module)
    env_id = NAMES.get(env_id, env_id)
    if episode_steps is not None and episode_steps < 1:
        raise ValueError("an episode has at least 1 step")
    try:
        env = gym.make(env_id, max_episode_steps=episode_steps, disable_env_checker=True, **options)
    except gym.error.UnregisteredEnv as error:
        known = "a registered Gymnasium id or MODULE:ID"
        raise ValueError(f"unknown environment {name!r} ({error}); choose one of {', '.join(NAMES)}, {known}") from None
    except Exception as error:  # whatever the constructor of somebody else's environment may raise
        raise ValueError(f"environment {name} cannot be made: {error}") from error
    _check_vectors(name, env)
    if env.spec is None or env.spec.max_episode_steps is None:
        raise ValueError(f"environment {name} is registered without a limit of steps: say how long an episode is (--episode-steps N)")
    return env


def hidden() -> list[str]:
    """Short names of the environments that hide a context."""
    return [name for name, env_id in NAMES.items() if issubclass(load_env_creator(gym.spec(env_id).entry_point), HiddenTask)]


def steps_max(env: gym.Env) -> int:
    """Steps after which an episode of an environment from `make` is truncated."""
    steps = env.spec and env.spec.max_episode_steps
    if not steps:
        raise ValueError(f"{env} has no limit of steps")
    return steps


def failed(env: gym.Env, episode_return: float) -> bool:
    """Whether the environment calls a finished episode failed; one that has no opinion never does."""
    opinion = getattr(env.unwrapped, "failed", None)
    return bool(callable(opinion) and opinion(episode_return))


def measures(env: gym.Env, episode_return: float) -> dict[str, float]:
    """What the environment says of a finished episode beside its return, by name; nothing where it has no words for it."""
    says = getattr(env.unwrapped, "measures", None)
    return says(episode_return) if callable(says) else {}


def goal(env: gym.Env) -> np.ndarray | None:
    """What the running episode wants, where the environment has goals: see `Task.goal`."""
    return getattr(env.unwrapped, "goal", None) if getattr(env.unwrapped, "goal_columns", ()) else None


def action_noise(env: gym.Env) -> tuple[float, ...]:
    """Standard deviations of the noise that the environment wants in its data; none where it says nothing."""
    return getattr(env.unwrapped, "action_noise", (0.0,))


def _import(module: str) -> None:
    try:
        importlib.import_module(module)
    except Exception as error:  # a module of the caller's: it may fail in any way
        raise ValueError(f"cannot import {module!r} to find its environments: {type(error).__name__}: {error}") from error


def _check_vectors(name: str, env: gym.Env) -> None:
    """Observations and actions travel as vectors of numbers."""
    for what, space, cure in (
        ("observations", env.observation_space, "gymnasium.wrappers.FlattenObservation makes vectors of boxes and of dicts of boxes"),
        ("actions", env.action_space, "choices are no numbers that could be diffused"),
    ):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"environment {name} has {space} as its {what}, but only vectors (a Box of one dimension) are taken; {cure}")
