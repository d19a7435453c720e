"""What an oracle is told: the true context, as its environment has it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

from ada_diffuser.messages import Model, SamplerOptions
from ada_diffuser.values import Floats


def true_context(env: gymnasium.Env[Any, Any], facts: Mapping[str, Any], model: Model, options: SamplerOptions) -> Floats | None:
    """For the next act in `env`, which said `facts` last: `(steps, dim)`; None for a model that is no oracle.

    One that is held is that of now: `coming_context(1)` where the environment has it, else `info["context"]`, which after a reset is that
    of the first step, and after a step that of the step. ValueError says what the environment lacks.
    """
    wanted = model.context
    if wanted is None:
        return None
    steps = 1 if wanted.future == "held" else model.plan_horizon + (options.action_horizon or 1) - 1
    told = _coming(env, steps)
    if told is None and wanted.future == "held" and "context" in facts:
        told = np.asarray(facts["context"]).reshape(1, -1)
    if told is None:
        held = 'neither has a `coming_context(steps)` nor tells `info["context"]`'
        lacks = held if wanted.future == "held" else "has no `coming_context(steps)` that tells it"
        raise ValueError(f"model {model.name} is an oracle of a context that is {wanted.future}, and the environment {lacks}")
    rows = np.asarray(told, np.float32)
    if rows.shape != (steps, wanted.dim):
        raise ValueError(f"model {model.name} is told a context of shape {(steps, wanted.dim)}, and the environment tells {rows.shape}")
    return rows


def _coming(env: gymnasium.Env[Any, Any], steps: int) -> Any:
    """What an environment of anybody's tells of the steps to come; None: nothing."""
    tells = getattr(env.unwrapped, "coming_context", None)
    return tells(steps) if callable(tells) else None
