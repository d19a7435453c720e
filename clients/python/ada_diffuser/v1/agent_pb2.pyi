from ada_diffuser.v1 import models_pb2 as _models_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union
from ada_diffuser.v1.models_pb2 import ListModelsRequest as ListModelsRequest
from ada_diffuser.v1.models_pb2 import ListModelsResponse as ListModelsResponse
from ada_diffuser.v1.models_pb2 import GetModelRequest as GetModelRequest
from ada_diffuser.v1.models_pb2 import GetModelResponse as GetModelResponse
from ada_diffuser.v1.models_pb2 import Model as Model
from ada_diffuser.v1.models_pb2 import Told as Told
from ada_diffuser.v1.models_pb2 import Returns as Returns
from ada_diffuser.v1.models_pb2 import TrueContext as TrueContext
from ada_diffuser.v1.models_pb2 import Trained as Trained
from ada_diffuser.v1.models_pb2 import Missing as Missing
from ada_diffuser.v1.models_pb2 import Vector as Vector
from ada_diffuser.v1.models_pb2 import SamplerOptions as SamplerOptions
from ada_diffuser.v1.models_pb2 import ToldKind as ToldKind
from ada_diffuser.v1.models_pb2 import TrueFuture as TrueFuture
from ada_diffuser.v1.models_pb2 import LatentMode as LatentMode

DESCRIPTOR: _descriptor.FileDescriptor
TOLD_KIND_UNSPECIFIED: _models_pb2.ToldKind
TOLD_KIND_RETURN: _models_pb2.ToldKind
TOLD_KIND_GOAL: _models_pb2.ToldKind
TRUE_FUTURE_UNSPECIFIED: _models_pb2.TrueFuture
TRUE_FUTURE_HELD: _models_pb2.TrueFuture
TRUE_FUTURE_KNOWN: _models_pb2.TrueFuture
LATENT_MODE_UNSPECIFIED: _models_pb2.LatentMode
LATENT_MODE_MEAN: _models_pb2.LatentMode
LATENT_MODE_SAMPLE: _models_pb2.LatentMode

class Start(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    START_UNSPECIFIED: _ClassVar[Start]
    START_COLD: _ClassVar[Start]
    START_WARM: _ClassVar[Start]
    START_RENOISED: _ClassVar[Start]

class SessionView(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SESSION_VIEW_UNSPECIFIED: _ClassVar[SessionView]
    SESSION_VIEW_BASIC: _ClassVar[SessionView]
    SESSION_VIEW_FULL: _ClassVar[SessionView]
START_UNSPECIFIED: Start
START_COLD: Start
START_WARM: Start
START_RENOISED: Start
SESSION_VIEW_UNSPECIFIED: SessionView
SESSION_VIEW_BASIC: SessionView
SESSION_VIEW_FULL: SessionView

class OpenSessionRequest(_message.Message):
    __slots__ = ("model", "seed", "options", "ttl_ms", "request_id", "history")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    TTL_MS_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    HISTORY_FIELD_NUMBER: _ClassVar[int]
    model: str
    seed: int
    options: _models_pb2.SamplerOptions
    ttl_ms: int
    request_id: str
    history: _containers.RepeatedCompositeFieldContainer[Executed]
    def __init__(self, model: _Optional[str] = ..., seed: _Optional[int] = ..., options: _Optional[_Union[_models_pb2.SamplerOptions, _Mapping]] = ..., ttl_ms: _Optional[int] = ..., request_id: _Optional[str] = ..., history: _Optional[_Iterable[_Union[Executed, _Mapping]]] = ...) -> None: ...

class OpenSessionResponse(_message.Message):
    __slots__ = ("session", "model")
    SESSION_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    session: Session
    model: _models_pb2.Model
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ..., model: _Optional[_Union[_models_pb2.Model, _Mapping]] = ...) -> None: ...

class ActRequest(_message.Message):
    __slots__ = ("session_id", "step", "observation", "deadline_ms", "want_planned_states", "episode")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    OBSERVATION_FIELD_NUMBER: _ClassVar[int]
    DEADLINE_MS_FIELD_NUMBER: _ClassVar[int]
    WANT_PLANNED_STATES_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    step: int
    observation: Observation
    deadline_ms: int
    want_planned_states: bool
    episode: int
    def __init__(self, session_id: _Optional[str] = ..., step: _Optional[int] = ..., observation: _Optional[_Union[Observation, _Mapping]] = ..., deadline_ms: _Optional[int] = ..., want_planned_states: bool = ..., episode: _Optional[int] = ...) -> None: ...

class Observation(_message.Message):
    __slots__ = ("state", "executed", "nothing_executed", "context")
    STATE_FIELD_NUMBER: _ClassVar[int]
    EXECUTED_FIELD_NUMBER: _ClassVar[int]
    NOTHING_EXECUTED_FIELD_NUMBER: _ClassVar[int]
    CONTEXT_FIELD_NUMBER: _ClassVar[int]
    state: _containers.RepeatedScalarFieldContainer[float]
    executed: _containers.RepeatedCompositeFieldContainer[Executed]
    nothing_executed: bool
    context: Matrix
    def __init__(self, state: _Optional[_Iterable[float]] = ..., executed: _Optional[_Iterable[_Union[Executed, _Mapping]]] = ..., nothing_executed: bool = ..., context: _Optional[_Union[Matrix, _Mapping]] = ...) -> None: ...

class Executed(_message.Message):
    __slots__ = ("state", "action", "reward")
    STATE_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    REWARD_FIELD_NUMBER: _ClassVar[int]
    state: _models_pb2.Vector
    action: _models_pb2.Vector
    reward: float
    def __init__(self, state: _Optional[_Union[_models_pb2.Vector, _Mapping]] = ..., action: _Optional[_Union[_models_pb2.Vector, _Mapping]] = ..., reward: _Optional[float] = ...) -> None: ...

class Matrix(_message.Message):
    __slots__ = ("values", "rows", "columns")
    VALUES_FIELD_NUMBER: _ClassVar[int]
    ROWS_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedScalarFieldContainer[float]
    rows: int
    columns: int
    def __init__(self, values: _Optional[_Iterable[float]] = ..., rows: _Optional[int] = ..., columns: _Optional[int] = ...) -> None: ...

class ActResponse(_message.Message):
    __slots__ = ("session_id", "step", "replayed", "actions", "planned_states", "latent_mean", "latent_log_var", "predicted_state", "evaluations", "start", "renoised_rungs", "timings", "model", "model_digest", "degraded", "passes", "value", "value_spread")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    REPLAYED_FIELD_NUMBER: _ClassVar[int]
    ACTIONS_FIELD_NUMBER: _ClassVar[int]
    PLANNED_STATES_FIELD_NUMBER: _ClassVar[int]
    LATENT_MEAN_FIELD_NUMBER: _ClassVar[int]
    LATENT_LOG_VAR_FIELD_NUMBER: _ClassVar[int]
    PREDICTED_STATE_FIELD_NUMBER: _ClassVar[int]
    EVALUATIONS_FIELD_NUMBER: _ClassVar[int]
    START_FIELD_NUMBER: _ClassVar[int]
    RENOISED_RUNGS_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    MODEL_DIGEST_FIELD_NUMBER: _ClassVar[int]
    DEGRADED_FIELD_NUMBER: _ClassVar[int]
    PASSES_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    VALUE_SPREAD_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    step: int
    replayed: bool
    actions: Matrix
    planned_states: Matrix
    latent_mean: _containers.RepeatedScalarFieldContainer[float]
    latent_log_var: _containers.RepeatedScalarFieldContainer[float]
    predicted_state: _containers.RepeatedScalarFieldContainer[float]
    evaluations: int
    start: Start
    renoised_rungs: int
    timings: Timings
    model: str
    model_digest: str
    degraded: bool
    passes: int
    value: float
    value_spread: float
    def __init__(self, session_id: _Optional[str] = ..., step: _Optional[int] = ..., replayed: bool = ..., actions: _Optional[_Union[Matrix, _Mapping]] = ..., planned_states: _Optional[_Union[Matrix, _Mapping]] = ..., latent_mean: _Optional[_Iterable[float]] = ..., latent_log_var: _Optional[_Iterable[float]] = ..., predicted_state: _Optional[_Iterable[float]] = ..., evaluations: _Optional[int] = ..., start: _Optional[_Union[Start, str]] = ..., renoised_rungs: _Optional[int] = ..., timings: _Optional[_Union[Timings, _Mapping]] = ..., model: _Optional[str] = ..., model_digest: _Optional[str] = ..., degraded: bool = ..., passes: _Optional[int] = ..., value: _Optional[float] = ..., value_spread: _Optional[float] = ...) -> None: ...

class Timings(_message.Message):
    __slots__ = ("queue_us", "compute_us", "commit_us", "total_us")
    QUEUE_US_FIELD_NUMBER: _ClassVar[int]
    COMPUTE_US_FIELD_NUMBER: _ClassVar[int]
    COMMIT_US_FIELD_NUMBER: _ClassVar[int]
    TOTAL_US_FIELD_NUMBER: _ClassVar[int]
    queue_us: int
    compute_us: int
    commit_us: int
    total_us: int
    def __init__(self, queue_us: _Optional[int] = ..., compute_us: _Optional[int] = ..., commit_us: _Optional[int] = ..., total_us: _Optional[int] = ...) -> None: ...

class ActResult(_message.Message):
    __slots__ = ("session_id", "step", "response", "error")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    RESPONSE_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    step: int
    response: ActResponse
    error: Error
    def __init__(self, session_id: _Optional[str] = ..., step: _Optional[int] = ..., response: _Optional[_Union[ActResponse, _Mapping]] = ..., error: _Optional[_Union[Error, _Mapping]] = ...) -> None: ...

class Error(_message.Message):
    __slots__ = ("code", "reason", "message", "field", "committed_step", "retry_after_ms", "error_id", "episode")
    CODE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    COMMITTED_STEP_FIELD_NUMBER: _ClassVar[int]
    RETRY_AFTER_MS_FIELD_NUMBER: _ClassVar[int]
    ERROR_ID_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    code: int
    reason: str
    message: str
    field: str
    committed_step: int
    retry_after_ms: int
    error_id: str
    episode: int
    def __init__(self, code: _Optional[int] = ..., reason: _Optional[str] = ..., message: _Optional[str] = ..., field: _Optional[str] = ..., committed_step: _Optional[int] = ..., retry_after_ms: _Optional[int] = ..., error_id: _Optional[str] = ..., episode: _Optional[int] = ...) -> None: ...

class ActBatchRequest(_message.Message):
    __slots__ = ("acts",)
    ACTS_FIELD_NUMBER: _ClassVar[int]
    acts: _containers.RepeatedCompositeFieldContainer[ActRequest]
    def __init__(self, acts: _Optional[_Iterable[_Union[ActRequest, _Mapping]]] = ...) -> None: ...

class ActBatchResponse(_message.Message):
    __slots__ = ("results",)
    RESULTS_FIELD_NUMBER: _ClassVar[int]
    results: _containers.RepeatedCompositeFieldContainer[ActResult]
    def __init__(self, results: _Optional[_Iterable[_Union[ActResult, _Mapping]]] = ...) -> None: ...

class ResetSessionRequest(_message.Message):
    __slots__ = ("session_id", "seed", "keep_history", "request_id", "episode")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    KEEP_HISTORY_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    seed: int
    keep_history: bool
    request_id: str
    episode: int
    def __init__(self, session_id: _Optional[str] = ..., seed: _Optional[int] = ..., keep_history: bool = ..., request_id: _Optional[str] = ..., episode: _Optional[int] = ...) -> None: ...

class ResetSessionResponse(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: Session
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ...) -> None: ...

class GetSessionRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class GetSessionResponse(_message.Message):
    __slots__ = ("session",)
    SESSION_FIELD_NUMBER: _ClassVar[int]
    session: Session
    def __init__(self, session: _Optional[_Union[Session, _Mapping]] = ...) -> None: ...

class ListSessionsRequest(_message.Message):
    __slots__ = ("page_size", "page_token", "model", "view")
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    VIEW_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    model: str
    view: SessionView
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ..., model: _Optional[str] = ..., view: _Optional[_Union[SessionView, str]] = ...) -> None: ...

class ListSessionsResponse(_message.Message):
    __slots__ = ("sessions", "next_page_token")
    SESSIONS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    sessions: _containers.RepeatedCompositeFieldContainer[Session]
    next_page_token: str
    def __init__(self, sessions: _Optional[_Iterable[_Union[Session, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class CloseSessionRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class CloseSessionResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ExportSessionRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class ExportSessionResponse(_message.Message):
    __slots__ = ("record",)
    RECORD_FIELD_NUMBER: _ClassVar[int]
    record: bytes
    def __init__(self, record: _Optional[bytes] = ...) -> None: ...

class ImportSessionRequest(_message.Message):
    __slots__ = ("record", "ttl_ms", "request_id")
    RECORD_FIELD_NUMBER: _ClassVar[int]
    TTL_MS_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    record: bytes
    ttl_ms: int
    request_id: str
    def __init__(self, record: _Optional[bytes] = ..., ttl_ms: _Optional[int] = ..., request_id: _Optional[str] = ...) -> None: ...

class SealSessionRequest(_message.Message):
    __slots__ = ("session_id",)
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    def __init__(self, session_id: _Optional[str] = ...) -> None: ...

class SealSessionResponse(_message.Message):
    __slots__ = ("token", "expires_in_ms")
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    EXPIRES_IN_MS_FIELD_NUMBER: _ClassVar[int]
    token: bytes
    expires_in_ms: int
    def __init__(self, token: _Optional[bytes] = ..., expires_in_ms: _Optional[int] = ...) -> None: ...

class ResumeSessionRequest(_message.Message):
    __slots__ = ("token",)
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    token: bytes
    def __init__(self, token: _Optional[bytes] = ...) -> None: ...

class ForkSessionRequest(_message.Message):
    __slots__ = ("session_id", "seed", "ttl_ms", "request_id", "step", "episode")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    TTL_MS_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    seed: int
    ttl_ms: int
    request_id: str
    step: int
    episode: int
    def __init__(self, session_id: _Optional[str] = ..., seed: _Optional[int] = ..., ttl_ms: _Optional[int] = ..., request_id: _Optional[str] = ..., step: _Optional[int] = ..., episode: _Optional[int] = ...) -> None: ...

class Session(_message.Message):
    __slots__ = ("session_id", "model", "model_digest", "seed", "committed_step", "episode", "options", "latent_mean", "latent_log_var", "age_ms", "idle_ms", "ttl_ms", "state_bytes", "busy", "handle")
    SESSION_ID_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    MODEL_DIGEST_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    COMMITTED_STEP_FIELD_NUMBER: _ClassVar[int]
    EPISODE_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    LATENT_MEAN_FIELD_NUMBER: _ClassVar[int]
    LATENT_LOG_VAR_FIELD_NUMBER: _ClassVar[int]
    AGE_MS_FIELD_NUMBER: _ClassVar[int]
    IDLE_MS_FIELD_NUMBER: _ClassVar[int]
    TTL_MS_FIELD_NUMBER: _ClassVar[int]
    STATE_BYTES_FIELD_NUMBER: _ClassVar[int]
    BUSY_FIELD_NUMBER: _ClassVar[int]
    HANDLE_FIELD_NUMBER: _ClassVar[int]
    session_id: str
    model: str
    model_digest: str
    seed: int
    committed_step: int
    episode: int
    options: _models_pb2.SamplerOptions
    latent_mean: _containers.RepeatedScalarFieldContainer[float]
    latent_log_var: _containers.RepeatedScalarFieldContainer[float]
    age_ms: int
    idle_ms: int
    ttl_ms: int
    state_bytes: int
    busy: bool
    handle: str
    def __init__(self, session_id: _Optional[str] = ..., model: _Optional[str] = ..., model_digest: _Optional[str] = ..., seed: _Optional[int] = ..., committed_step: _Optional[int] = ..., episode: _Optional[int] = ..., options: _Optional[_Union[_models_pb2.SamplerOptions, _Mapping]] = ..., latent_mean: _Optional[_Iterable[float]] = ..., latent_log_var: _Optional[_Iterable[float]] = ..., age_ms: _Optional[int] = ..., idle_ms: _Optional[int] = ..., ttl_ms: _Optional[int] = ..., state_bytes: _Optional[int] = ..., busy: bool = ..., handle: _Optional[str] = ...) -> None: ...
