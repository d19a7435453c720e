"""The messages of both faces as plain data: what `proto/ada_diffuser/v1` says, with numpy arrays.

Values are in the units of the data set and travel as float32.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, Literal

from numpy.typing import ArrayLike

from ada_diffuser.values import Floats, flag, invalid, number, text, vector, whole

LatentMode = Literal["mean", "sample"]
Start = Literal["cold", "warm", "renoised"]


@dataclass(frozen=True)
class SamplerOptions:
    """How a chunk is sampled. In a request None means the model's default; in an answer every field is set."""

    #: Keep the partly denoised window between acts.
    streaming: bool | None = None
    #: Actions that one act returns.
    action_horizon: int | None = None
    #: Sub-steps per rung of the ladder.
    sub_steps: int | None = None
    #: 0 is DDIM, 1 is DDPM.
    eta: float | None = None
    #: Factor on the standard deviation of all noise.
    temperature: float | None = None
    #: Trust region of the zig-zag refinement in nats: 0 is off, infinity is as in the paper.
    kappa: float | None = None
    #: Whether latents are drawn or their means are used.
    latent: LatentMode | None = None

    @classmethod
    def parse(cls, words: Mapping[str, str]) -> SamplerOptions:
        """From text, as a command line has it: `{"streaming": "false", "kappa": "inf"}`. ValueError names the wrong one."""
        unknown = set(words) - set(_PARSERS)
        if unknown:
            raise ValueError(f"no such option: {', '.join(sorted(unknown))}; there are {', '.join(_PARSERS)}")
        values: dict[str, Any] = {}
        for name, word in words.items():
            try:
                values[name] = _PARSERS[name](word)
            except ValueError as error:
                raise ValueError(f"option {name}: {error}") from None
        return cls(**values)

    def given(self) -> dict[str, Any]:
        """The fields that are set."""
        pairs = ((item.name, getattr(self, item.name)) for item in fields(self))
        return {name: value for name, value in pairs if value is not None}

    def checked(self) -> SamplerOptions:
        """With plain numbers and flags, as they travel; InvalidInput names the wrong one."""
        return replace(self, **{name: _CHECKS[name](value, f"options.{name}") for name, value in self.given().items()})


def _flag(word: str) -> bool:
    if word.lower() not in ("true", "false"):
        raise ValueError(f"{word!r} is neither true nor false")
    return word.lower() == "true"


def _latent_mode(word: str) -> str:
    if word not in ("mean", "sample"):
        raise ValueError(f"{word!r} is neither mean nor sample")
    return word


_PARSERS: dict[str, Any] = {
    "streaming": _flag,
    "action_horizon": int,
    "sub_steps": int,
    "eta": float,
    "temperature": float,
    "kappa": float,
    "latent": _latent_mode,
}


def _checked_mode(value: Any, field: str) -> str:
    if text(value, field) not in ("mean", "sample"):
        raise invalid(field, f"{value!r} is neither mean nor sample")
    return str(value)


_CHECKS: dict[str, Callable[[Any, str], Any]] = {
    "streaming": flag,
    "action_horizon": partial(whole, bits=32),
    "sub_steps": partial(whole, bits=32),
    "eta": number,
    "temperature": number,
    "kappa": partial(number, infinity=True),
    "latent": _checked_mode,
}


@dataclass(frozen=True, eq=False)
class Executed:
    """One executed step; what is None is unknown, and masked."""

    #: The state in which it was executed, `(state_dim,)`; in the first one of an act: that of the last observation.
    state: ArrayLike | None = None
    #: The action, `(action_dim,)`; None: the one that was returned for this step.
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


@dataclass(frozen=True, eq=False)
class ExecutedValues:
    """`Executed` as it travels: checked, float32."""

    state: Floats | None
    action: Floats | None
    reward: float | None


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


def executed_values(executed: Sequence[Executed]) -> tuple[ExecutedValues, ...]:
    """The executed steps of an observation, checked."""
    values = []
    for i, step in enumerate(executed):
        path = f"observation.executed[{i}]"
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
    #: Denoiser evaluations that the act took.
    evaluations: int
    start: Start
    renoised_rungs: int
    timings: Timings
    model: str
    model_digest: str
    degraded: bool


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
    #: Whether histories crossed from one episode into the next, so that a reset may keep them.
    sessions: bool = False


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
