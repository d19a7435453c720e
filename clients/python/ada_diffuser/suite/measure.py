"""What a served checkpoint earns, costs and knows in one mode, as the numbers of a cell's file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ada_diffuser.client import Client
from ada_diffuser.commands.progress import progress
from ada_diffuser.messages import SamplerOptions
from ada_diffuser.rollout import Episode, Evaluation, Trial, check, evaluate
from ada_diffuser.rollout.clusters import on_axes
from ada_diffuser.rollout.readout import Reading, pairs, read
from ada_diffuser.rollout.result import plain_options
from ada_diffuser.suite.cell import Cell
from ada_diffuser.suite.suite import Mode

#: Episodes side by side, at most.
VECTOR = 64
#: Episodes that are played one by one besides, for the time of an act and for its plans.
ALONE = 2
#: Latents, steps and plans that are kept to be drawn.
LATENTS_DRAWN = 200
STEPS_DRAWN = 60


def measured(client: Client, cell: Cell, mode: Mode, model: str) -> dict[str, Any]:
    """Rolls the model out; numbers of all episodes, each return, and a little to draw of the suite's first training seed."""
    suite, world = cell.suite, cell.environment
    options = SamplerOptions(streaming=mode == "streaming")
    trial = Trial(world.env, model, suite.episodes, suite.first_seed, VECTOR, options, world.episode_steps, env_options=world.options)
    with progress(trial.episodes * check(client, trial), mode, "step") as advance:
        result = evaluate(client, trial, advance)
    alone = evaluate(client, replace(trial, episodes=ALONE, vector=1, planned_states=True))
    reading = read(result)
    drawn = cell.seed == suite.seeds[0]
    return {
        "mode": mode,
        "options": plain_options(asdict(result.options)),
        "episodes": len(result.episodes),
        "first_seed": trial.seed,
        "mean": round(result.mean_return, 4),
        "se": round(result.standard_error, 4),
        "median": round(result.median_return, 4),
        "failures": result.failures,
        **({"measures": _measures(result)} if result.measures else {}),
        "returns": [round(value, 4) for value in result.returns.tolist()],
        "evaluations_per_act": round(result.evaluations_per_act, 4),
        "p50_ms": round(alone.latency_ms(50), 4),
        "rollout_seconds": round(result.wall_s + alone.wall_s, 1),
        "readout": _readout(reading),
        "latents": _latents(result) if drawn and reading.clusters else None,
        "plan": plan(alone.episodes, alone.options.action_horizon or 1, drawn=drawn),
    }


def _measures(result: Evaluation) -> dict[str, list[float]]:
    """What the environment says of each episode beside its return."""
    return {name: [round(value, 4) for value in one.values] for name, one in result.measures.items()}


def _readout(reading: Reading) -> dict[str, Any] | None:
    """What the latents tell of the context on these episodes; None where there is nothing to read."""
    if not reading.clusters:
        return None
    ages = [{"age": list(one.age), "mse": round(one.mse, 5), "se": round(one.standard_error, 5)} for one in reading.errors("all")]
    groups = {name: round(value, 4) for name, value in reading.clusters.as_json().items() if name in ("adjusted_rand_index", "purity")}
    return {"evidence": reading.evidence, "ages": ages, **groups}


def _latents(result: Evaluation) -> dict[str, Any]:
    """Some acts on the latents' two principal axes, each with the context on its first one."""
    latents, contexts = pairs(result.episodes)
    (plane, shares), (context, _) = on_axes(latents), on_axes(contexts)
    values = contexts[:, 0] if contexts.shape[1] == 1 else context[:, 0]
    step = -(-len(plane) // LATENTS_DRAWN)
    points = np.column_stack([plane, values])[::step]
    return {"shares": [round(share, 4) for share in shares], "points": _rounded(points)}


def plan(episodes: Sequence[Episode], action_horizon: int, *, drawn: bool) -> dict[str, Any] | None:
    """How far planned states are from those that were seen so many steps later: the squared error of each column over its variance.

    None where no plan reached a state that was seen. With `drawn` also some plans of the first episode beside what happened.
    """
    scale = np.concatenate([np.array(one.states) for one in episodes]).std(axis=0)
    varies = scale > 0
    errors = [_errors(one, action_horizon)[..., varies] / scale[varies] for one in episodes if one.plans and varies.any()]
    if not errors:
        return None
    squared = np.concatenate(errors) ** 2
    reached = ~np.isnan(squared).all(axis=(0, 2))
    means = np.nanmean(squared[:, reached], axis=(0, 2))
    told = {"ahead": (action_horizon + np.flatnonzero(reached)).tolist(), "error": [round(value, 5) for value in means.tolist()]}
    return told | (_drawn(episodes[0], action_horizon, int(scale.argmax())) if drawn else {})


def _errors(episode: Episode, action_horizon: int) -> NDArray[np.float64]:
    """Planned less seen, `(acts, states of a plan, state_dim)`; NaN beyond the end of the episode."""
    states, plans = np.array(episode.states, np.float64), np.array(episode.plans, np.float64)
    at = np.array(episode.act_steps)[:, None] + action_horizon + np.arange(plans.shape[1])
    seen = states[np.minimum(at, len(states) - 1)]
    seen[at >= len(states)] = np.nan
    return plans - seen


def _drawn(episode: Episode, action_horizon: int, column: int) -> dict[str, Any]:
    """The column that varies most, and plans of it that hardly overlap."""
    length = len(episode.plans[0])
    plans: list[dict[str, Any]] = []
    for step, planned in zip(episode.act_steps, episode.plans, strict=True):
        if step >= STEPS_DRAWN - length:
            break
        if not plans or step + action_horizon > plans[-1]["step"] + length:
            plans.append({"step": step + action_horizon, "states": _rounded(planned[:, column])})
    states = np.array([state[column] for state in episode.states[:STEPS_DRAWN]])
    return {"column": column, "states": _rounded(states), "plans": plans}


def _rounded(values: NDArray[Any]) -> list[Any]:
    return np.round(np.asarray(values, np.float64), 4).tolist()
