"""The messages of both faces as plain data: what `proto/ada_diffuser/v1` says, with numpy arrays.

Values are in the units of the data set and travel as float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from numpy.typing import ArrayLike

from ada_diffuser.options import LatentMode, SamplerOptions
from ada_diffuser.values import Floats, invalid, number, vector

__all__ = [
    "ActCall",
    "Chunk",
    "Executed",
    "ExecutedValues",
    "LatentMode",
    "Missing",
    "Model",
    "Observation",
    "OpenCall",
    "Returns",
    "SamplerOptions",
    "SessionSummary",
    "Start",
    "Timings",
    "Told",
    "Trained",
    "TrueContext",
    "executed_values",
]

Start = Literal["cold", "warm", "renoised"]


@dataclass(frozen=True, eq=False)
class Executed:
    """One executed step; what is None is unknown, and masked."""

    #: The state in which it was executed, `(state_dim,)`; None in the first one of an act: that of the last observation.
    state: ArrayLike | None = None
    #: The action, `(action_dim,)`; None: the one that was returned for this step, if one was.
    action: ArrayLike | None = None
    #: The reward that followed: a number, or an array of one.
    reward: ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class Observation:
    """What was seen since the last act."""

    #: The current state, `(state_dim,)`.
    state: ArrayLike
    #: What was executed since, oldest first. Empty: the whole last chunk, and nothing else is known. More steps than it held
    #: (after a break, or before the first act) need their actions.
    executed: Sequence[Executed] = ()
    #: Nothing of the last chunk was executed and no time has passed: this act takes its place. Excludes `executed`.
    nothing_executed: bool = False
    #: The true context of now and of the steps to come, `(steps, dim)`, or of now alone, `(dim,)`: for an oracle, which cannot act without
    #: (`Model.context`); any other model takes none.
    context: ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class ExecutedValues:
    """`Executed` as it travels: checked, float32."""

    state: Floats | None
    action: Floats | None
    reward: float | None


@dataclass(frozen=True, eq=False)
class ForkCall:
    """One fork on the wire, the same value for every attempt: of the step where the client stands, so that it is refused anywhere else."""

    session_id: str
    seed: int | None
    ttl_ms: int | None
    request_id: str
    step: int
    episode: int


@dataclass(frozen=True, eq=False)
class OpenCall:
    """One open on the wire. A retry sends this very value again, so it gets the session that the first attempt opened."""

    model: str
    seed: int | None
    options: SamplerOptions
    ttl_ms: int | None
    #: Of this request: while its session lives, no other is opened by it.
    request_id: str
    history: tuple[ExecutedValues, ...] = ()


@dataclass(frozen=True, eq=False)
class ActCall:
    """One act on the wire. A retry sends this very value again, so it can never become another step."""

    session_id: str
    step: int
    #: The episode that it belongs to: a copy that the network delivers after a reset is refused.
    episode: int
    state: Floats
    executed: tuple[ExecutedValues, ...]
    nothing_executed: bool = False
    deadline_ms: int | None = None
    want_planned_states: bool = False
    #: `(steps, dim)`.
    context: Floats | None = None


def executed_values(executed: Sequence[Executed], field: str) -> tuple[ExecutedValues, ...]:
    """The executed steps of this field, checked."""
    values = []
    for i, step in enumerate(executed):
        path = f"{field}[{i}]"
        if not isinstance(step, Executed):
            raise invalid(path, f"is no Executed, but a {type(step).__name__}")
        state = None if step.state is None else vector(step.state, f"{path}.state")
        action = None if step.action is None else vector(step.action, f"{path}.action")
        reward = None if step.reward is None else number(step.reward, f"{path}.reward")
        values.append(ExecutedValues(state, action, reward))
    return tuple(values)


@dataclass(frozen=True)
class Timings:
    """Where the time of an act went, in microseconds on the server."""

    queue_us: int
    compute_us: int
    commit_us: int
    total_us: int


@dataclass(frozen=True, eq=False)
class Chunk:
    """The answer of an act."""

    session_id: str
    #: The step that is committed now.
    step: int
    #: Whether this is the answer of an earlier call of the same step; all else is then as in the first answer.
    replayed: bool
    #: `(action_horizon, action_dim)`.
    actions: Floats
    #: `(plan_horizon - 1, state_dim)`, if asked for: states after the chunk's last action.
    planned_states: Floats | None
    #: Mean of the latent at the chunk's first step, `(latent_dim,)`.
    latent_mean: Floats
    latent_log_var: Floats
    #: Predicted state after the chunk's last action, `(state_dim,)`.
    predicted_state: Floats
    #: Windows that the denoiser evaluated.
    evaluations: int
    start: Start
    renoised_rungs: int
    timings: Timings
    model: str
    model_digest: str
    degraded: bool
    #: Forwards of the denoiser that the act took part in, one after the other: fewer, where several rows are evaluated at once.
    passes: int = 0
    #: What the guide holds the plan to be worth: the discounted mean of the rewards to come. None where it neither led nor chose it.
    value: float | None = None
    #: Standard deviation of that over the candidates.
    value_spread: float | None = None


@dataclass(frozen=True)
class Missing:
    """Parts of an executed step that may be missing without being guessed; otherwise a missing reward is taken to be the mean one."""

    state: bool
    action: bool
    reward: bool


@dataclass(frozen=True)
class Trained:
    """What a session may ask for and leave out, because training did so too."""

    #: Chunk lengths (T_a), ascending.
    action_horizons: tuple[int, ...]
    #: Sub-steps per rung, ascending.
    sub_steps: tuple[int, ...]
    missing: Missing
    #: Whether histories crossed from one episode into the next, so that a reset may keep one, and an open bring one.
    sessions: bool = False


@dataclass(frozen=True)
class Told:
    """Something that a session may tell of what it wants: `SamplerOptions.told_return` or `told_goal`."""

    kind: Literal["return", "goal"]
    #: With a goal: the columns of the state that are meant, in the order of its values.
    columns: tuple[int, ...] = ()


@dataclass(frozen=True)
class Returns:
    """How large the data's returns are, the discounted means of the rewards to come."""

    mean: float
    #: Standard deviation.
    std: float


@dataclass(frozen=True)
class TrueContext:
    """The true context, as an oracle has to be told it in `Observation.context`."""

    #: Values of each row.
    dim: int
    #: `held`: one row, that of now, which holds for all of the window; `known`: those of the steps to come as well, 1 to
    #: `plan_horizon + action_horizon - 1` rows, of which the last holds for what comes then.
    future: Literal["held", "known"]


@dataclass(frozen=True, eq=False)
class Model:
    """What a client must know of a model."""

    name: str
    digest: str
    is_default: bool
    state_dim: int
    action_dim: int
    plan_horizon: int
    block_len: int
    obs_horizon: int
    latent_dim: int
    level_max: int
    #: Bounds of each action value, `(action_dim,)`.
    action_low: Floats
    action_high: Floats
    sampler: SamplerOptions
    #: Whether it was trained with zig-zag refinement; without it `kappa` other than 0 is refused.
    refined: bool
    trained: Trained
    #: What a session may tell of what it wants: all of it, or nothing.
    told: tuple[Told, ...] = ()
    #: None where the model knows of none.
    returns: Returns | None = None
    #: Whether it has a guide, which leads windows (`guidance_scale`) and chooses among `candidates`, and then says what it holds them
    #: to be worth (`Chunk.value`).
    guide: bool = False
    #: Of an oracle; None: it finds out by itself, or knows nothing of it, and takes no context.
    context: TrueContext | None = None


@dataclass(frozen=True, eq=False)
class SessionSummary:
    """The state of a session on the server."""

    #: Whoever knows it may use the session; empty in lists.
    session_id: str
    #: The session's name in lists.
    handle: str
    model: str
    model_digest: str
    seed: int
    #: Acts committed in the running episode; the next one is this + 1.
    committed_step: int
    episode: int
    options: SamplerOptions
    latent_mean: Floats
    latent_log_var: Floats
    age_ms: int
    idle_ms: int
    ttl_ms: int
    state_bytes: int
    busy: bool
