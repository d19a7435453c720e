"""The JSON of the REST face <-> plain data."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from ada_diffuser.errors import AdaError, Detail, UnexpectedAnswer, from_detail
from ada_diffuser.messages import (
    ActCall,
    Chunk,
    ExecutedValues,
    Missing,
    Model,
    OpenCall,
    Returns,
    SamplerOptions,
    SessionSummary,
    Timings,
    Told,
    Trained,
    TrueContext,
)
from ada_diffuser.options import BOUND, NUMBER, NUMBERS, Kind
from ada_diffuser.values import Floats

T = TypeVar("T")


def without_none(**pairs: Any) -> dict[str, Any]:
    """The fields that are set."""
    return {name: value for name, value in pairs.items() if value is not None}


def open_body(call: OpenCall) -> dict[str, Any]:
    """An open."""
    return without_none(
        model=call.model or None,
        seed=call.seed,
        options=options_out(call.options) or None,
        ttl_ms=call.ttl_ms,
        request_id=call.request_id,
        history=_steps(call.history) or None,
    )


def _steps(steps: Sequence[ExecutedValues]) -> list[dict[str, Any]]:
    return [
        without_none(
            state=None if step.state is None else step.state.tolist(),
            action=None if step.action is None else step.action.tolist(),
            reward=step.reward,
        )
        for step in steps
    ]


def act_body(call: ActCall) -> dict[str, Any]:
    """An act, but for its session."""
    return without_none(
        step=call.step,
        episode=call.episode,
        observation=without_none(
            state=call.state.tolist(),
            executed=_steps(call.executed),
            nothing_executed=call.nothing_executed or None,
            context=None if call.context is None else call.context.tolist(),
        ),
        deadline_ms=call.deadline_ms,
        want_planned_states=call.want_planned_states or None,
    )


def _float32(value: float) -> float:
    """The number that a decimal fraction stands for: as gRPC has it."""
    return float(np.float32(value))


_SPELL: dict[Kind, Callable[[Any], Any]] = {BOUND: lambda value: "infinity" if value == math.inf else value}
_READ: dict[Kind, Callable[[Any], Any]] = {
    NUMBER: _float32,
    BOUND: lambda value: math.inf if value == "infinity" else _float32(value),
    NUMBERS: lambda values: tuple(map(_float32, values)),
}


def options_out(options: SamplerOptions) -> dict[str, Any]:
    """Those that are set."""
    return options.sent(_SPELL)


def _options_in(options: Mapping[str, Any]) -> SamplerOptions:
    return SamplerOptions.received(options, _READ)


def binary(text: str) -> bytes:
    """What stands in the JSON as base64."""
    return base64.b64decode(text, validate=True)


def binary_out(value: bytes) -> str:
    """The same on its way out."""
    return base64.b64encode(value).decode()


def read(convert: Callable[[Any], T], answer: Any, *path: str) -> T:
    """`convert(answer[path])`; an answer of another shape is an error, not a KeyError in the caller's program."""
    try:
        for name in path:
            answer = answer[name]
        return convert(answer)
    except (KeyError, TypeError, ValueError) as error:
        raise UnexpectedAnswer(f"the answer is not of the expected shape ({type(error).__name__}: {error})") from None


def error_of_problem(problem: Mapping[str, Any], status: int) -> AdaError:
    """What an `application/problem+json` says, or whatever else came in its place."""
    detail = Detail(
        message=str(problem.get("detail") or problem.get("title") or f"status {status}"),
        reason=str(problem.get("reason") or ""),
        field=str(problem.get("field") or ""),
        committed_step=problem.get("committed_step"),
        retry_after_ms=problem.get("retry_after_ms"),
        error_id=str(problem.get("error_id") or ""),
    )
    return from_detail(detail, http_status=status)


def _floats(values: Any) -> Floats:
    return np.array(values, dtype=np.float32)


def results(results: Sequence[Mapping[str, Any]]) -> list[Chunk | AdaError]:
    """Of a batch."""
    return [
        chunk(result["response"])
        if result.get("response") is not None
        else error_of_problem(result["error"], int(result["error"].get("status", 500)))
        for result in results
    ]


def chunk(answer: Mapping[str, Any]) -> Chunk:
    """Of an act."""
    timings = answer["timings"]
    planned = answer.get("planned_states")
    return Chunk(
        session_id=answer["session_id"],
        step=answer["step"],
        replayed=answer["replayed"],
        actions=_floats(answer["actions"]),
        planned_states=None if planned is None else _floats(planned),
        latent_mean=_floats(answer["latent_mean"]),
        latent_log_var=_floats(answer["latent_log_var"]),
        predicted_state=_floats(answer["predicted_state"]),
        evaluations=answer["evaluations"],
        start=answer["start"],
        renoised_rungs=answer.get("renoised_rungs", 0),
        timings=Timings(timings["queue_us"], timings["compute_us"], timings["commit_us"], timings["total_us"]),
        model=answer["model"],
        model_digest=answer["model_digest"],
        degraded=answer.get("degraded", False),
        passes=answer.get("passes", 0),
        value=_float32_if_any(answer.get("value")),
        value_spread=_float32_if_any(answer.get("value_spread")),
    )


def _float32_if_any(value: float | None) -> float | None:
    return None if value is None else _float32(value)


def model(model: Mapping[str, Any]) -> Model:
    """As it stands in a list, too."""
    special = ("action_low", "action_high", "sampler", "trained", "told", "returns", "guide", "context")
    plain = {name: model[name] for name in Model.__dataclass_fields__ if name not in special}
    trained, returns, context = model["trained"], model.get("returns"), model.get("context")
    return Model(
        **plain,
        action_low=_floats(model["action_low"]),
        action_high=_floats(model["action_high"]),
        sampler=_options_in(model["sampler"]),
        trained=Trained(tuple(trained["action_horizons"]), tuple(trained["sub_steps"]), Missing(**trained["missing"]), trained["sessions"]),
        told=tuple(Told(told["kind"], tuple(told["columns"])) for told in model.get("told", ())),
        returns=Returns(_float32(returns["mean"]), _float32(returns["std"])) if returns else None,
        guide=model.get("guide", False),
        context=TrueContext(context["dim"], context["future"]) if context else None,
    )


def summary(session: Mapping[str, Any]) -> SessionSummary:
    """With its `session_id`, which a list leaves out."""
    special = ("options", "latent_mean", "latent_log_var")
    # Servers before 0.1 have no handles.
    session = {"handle": "", **session}
    plain = {name: session[name] for name in SessionSummary.__dataclass_fields__ if name not in special}
    return SessionSummary(
        **plain,
        options=_options_in(session["options"]),
        latent_mean=_floats(session["latent_mean"]),
        latent_log_var=_floats(session["latent_log_var"]),
    )
