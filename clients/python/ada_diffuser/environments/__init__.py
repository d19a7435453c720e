"""Environments with a hidden context; importing this module registers them with Gymnasium.

    import gymnasium, ada_diffuser.environments
    env = gymnasium.make("ada/PointWind-S-v0")

`-S` contexts change within an episode, `-E` contexts between episodes. The context is in `info["context"]` alone:
the array returned by step `t` acted while `a_t` was executed, the one returned by `reset` acts on the first step.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from .cheetah import CheetahVelE, CheetahWindE, CheetahWindS
from .point_wind import PointWindS

__all__ = ["EPISODE_STEPS", "NAMES", "CheetahVelE", "CheetahWindE", "CheetahWindS", "PointWindS", "make", "register_all"]

EPISODE_STEPS = 200
"""Steps after which every episode here is truncated; none terminates."""

NAMES = {
    "point-wind-s": "ada/PointWind-S-v0",
    "cheetah-wind-s": "ada/CheetahWind-S-v0",
    "cheetah-wind-e": "ada/CheetahWind-E-v0",
    "cheetah-vel-e": "ada/CheetahVel-E-v0",
}
"""Short name for command lines -> Gymnasium id."""

_ENTRY_POINTS = {
    "ada/PointWind-S-v0": f"{__name__}.point_wind:PointWindS",
    "ada/CheetahWind-S-v0": f"{__name__}.cheetah:CheetahWindS",
    "ada/CheetahWind-E-v0": f"{__name__}.cheetah:CheetahWindE",
    "ada/CheetahVel-E-v0": f"{__name__}.cheetah:CheetahVelE",
}


def register_all() -> None:
    """Register the four environments; a second call changes nothing."""
    for env_id, entry_point in _ENTRY_POINTS.items():
        if env_id not in gym.registry:
            gym.register(env_id, entry_point=entry_point, max_episode_steps=EPISODE_STEPS)


def make(name: str, **options: Any) -> gym.Env:
    """Make an environment by short name or Gymnasium id. Raises `ValueError` naming the choices for an unknown name."""
    env_id = NAMES.get(name, name)
    if env_id not in gym.registry:
        raise ValueError(f"unknown environment {name!r}; choose one of {', '.join(NAMES)} or a registered Gymnasium id")
    return gym.make(env_id, disable_env_checker=True, **options)


register_all()
