"""What a model is told of the goal of an episode, as its environment has it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np

from ada_diffuser.client import Client
from ada_diffuser.messages import SamplerOptions
from ada_diffuser.rollout.result import Trial


def wanted_columns(client: Client, trial: Trial, env: gymnasium.Env[Any, Any]) -> tuple[int, ...]:
    """The columns of the state that the model is told of each episode's goal; none where it takes no goal, the environment has none, or the
    trial says one for all. ValueError where the two do not fit.
    """
    told = tuple(getattr(env.unwrapped, "goal_columns", ()))
    if not told or trial.options.told_goal is not None:
        return ()
    model = client.model(trial.model)
    wanted = next((one.columns for one in model.told if one.kind == "goal"), ())
    if not set(wanted) <= set(told):
        raise ValueError(
            f"model {model.name} is told a goal in columns {list(wanted)} of the state, and {trial.env} has one in {list(told)}"
        )
    if wanted and trial.session_episodes > 1 and not trial.forget:
        raise ValueError("a goal is told when a session begins: episodes with goals of their own cannot follow one another in one")
    return wanted


def with_goal(options: SamplerOptions, env: gymnasium.Env[Any, Any], columns: tuple[int, ...]) -> SamplerOptions:
    """The options with the goal of the episode that has just begun in `env`; as they are without columns."""
    if not columns:
        return options
    told: Any = env.unwrapped
    goal = dict(zip(told.goal_columns, np.asarray(told.goal, np.float64).tolist(), strict=True))
    return replace(options, told_goal=tuple(goal[column] for column in columns))
