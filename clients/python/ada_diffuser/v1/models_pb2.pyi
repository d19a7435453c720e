from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ToldKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TOLD_KIND_UNSPECIFIED: _ClassVar[ToldKind]
    TOLD_KIND_RETURN: _ClassVar[ToldKind]
    TOLD_KIND_GOAL: _ClassVar[ToldKind]

class TrueFuture(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRUE_FUTURE_UNSPECIFIED: _ClassVar[TrueFuture]
    TRUE_FUTURE_HELD: _ClassVar[TrueFuture]
    TRUE_FUTURE_KNOWN: _ClassVar[TrueFuture]

class LatentMode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LATENT_MODE_UNSPECIFIED: _ClassVar[LatentMode]
    LATENT_MODE_MEAN: _ClassVar[LatentMode]
    LATENT_MODE_SAMPLE: _ClassVar[LatentMode]
TOLD_KIND_UNSPECIFIED: ToldKind
TOLD_KIND_RETURN: ToldKind
TOLD_KIND_GOAL: ToldKind
TRUE_FUTURE_UNSPECIFIED: TrueFuture
TRUE_FUTURE_HELD: TrueFuture
TRUE_FUTURE_KNOWN: TrueFuture
LATENT_MODE_UNSPECIFIED: LatentMode
LATENT_MODE_MEAN: LatentMode
LATENT_MODE_SAMPLE: LatentMode

class ListModelsRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ListModelsResponse(_message.Message):
    __slots__ = ("models",)
    MODELS_FIELD_NUMBER: _ClassVar[int]
    models: _containers.RepeatedCompositeFieldContainer[Model]
    def __init__(self, models: _Optional[_Iterable[_Union[Model, _Mapping]]] = ...) -> None: ...

class GetModelRequest(_message.Message):
    __slots__ = ("model",)
    MODEL_FIELD_NUMBER: _ClassVar[int]
    model: str
    def __init__(self, model: _Optional[str] = ...) -> None: ...

class GetModelResponse(_message.Message):
    __slots__ = ("model",)
    MODEL_FIELD_NUMBER: _ClassVar[int]
    model: Model
    def __init__(self, model: _Optional[_Union[Model, _Mapping]] = ...) -> None: ...

class Model(_message.Message):
    __slots__ = ("name", "digest", "is_default", "state_dim", "action_dim", "plan_horizon", "block_len", "obs_horizon", "latent_dim", "level_max", "action_low", "action_high", "sampler", "refined", "trained", "told", "returns", "guide", "context")
    NAME_FIELD_NUMBER: _ClassVar[int]
    DIGEST_FIELD_NUMBER: _ClassVar[int]
    IS_DEFAULT_FIELD_NUMBER: _ClassVar[int]
    STATE_DIM_FIELD_NUMBER: _ClassVar[int]
    ACTION_DIM_FIELD_NUMBER: _ClassVar[int]
    PLAN_HORIZON_FIELD_NUMBER: _ClassVar[int]
    BLOCK_LEN_FIELD_NUMBER: _ClassVar[int]
    OBS_HORIZON_FIELD_NUMBER: _ClassVar[int]
    LATENT_DIM_FIELD_NUMBER: _ClassVar[int]
    LEVEL_MAX_FIELD_NUMBER: _ClassVar[int]
    ACTION_LOW_FIELD_NUMBER: _ClassVar[int]
    ACTION_HIGH_FIELD_NUMBER: _ClassVar[int]
    SAMPLER_FIELD_NUMBER: _ClassVar[int]
    REFINED_FIELD_NUMBER: _ClassVar[int]
    TRAINED_FIELD_NUMBER: _ClassVar[int]
    TOLD_FIELD_NUMBER: _ClassVar[int]
    RETURNS_FIELD_NUMBER: _ClassVar[int]
    GUIDE_FIELD_NUMBER: _ClassVar[int]
    CONTEXT_FIELD_NUMBER: _ClassVar[int]
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
    action_low: _containers.RepeatedScalarFieldContainer[float]
    action_high: _containers.RepeatedScalarFieldContainer[float]
    sampler: SamplerOptions
    refined: bool
    trained: Trained
    told: _containers.RepeatedCompositeFieldContainer[Told]
    returns: Returns
    guide: bool
    context: TrueContext
    def __init__(self, name: _Optional[str] = ..., digest: _Optional[str] = ..., is_default: bool = ..., state_dim: _Optional[int] = ..., action_dim: _Optional[int] = ..., plan_horizon: _Optional[int] = ..., block_len: _Optional[int] = ..., obs_horizon: _Optional[int] = ..., latent_dim: _Optional[int] = ..., level_max: _Optional[int] = ..., action_low: _Optional[_Iterable[float]] = ..., action_high: _Optional[_Iterable[float]] = ..., sampler: _Optional[_Union[SamplerOptions, _Mapping]] = ..., refined: bool = ..., trained: _Optional[_Union[Trained, _Mapping]] = ..., told: _Optional[_Iterable[_Union[Told, _Mapping]]] = ..., returns: _Optional[_Union[Returns, _Mapping]] = ..., guide: bool = ..., context: _Optional[_Union[TrueContext, _Mapping]] = ...) -> None: ...

class Told(_message.Message):
    __slots__ = ("kind", "columns")
    KIND_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    kind: ToldKind
    columns: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, kind: _Optional[_Union[ToldKind, str]] = ..., columns: _Optional[_Iterable[int]] = ...) -> None: ...

class Returns(_message.Message):
    __slots__ = ("mean", "std")
    MEAN_FIELD_NUMBER: _ClassVar[int]
    STD_FIELD_NUMBER: _ClassVar[int]
    mean: float
    std: float
    def __init__(self, mean: _Optional[float] = ..., std: _Optional[float] = ...) -> None: ...

class TrueContext(_message.Message):
    __slots__ = ("dim", "future")
    DIM_FIELD_NUMBER: _ClassVar[int]
    FUTURE_FIELD_NUMBER: _ClassVar[int]
    dim: int
    future: TrueFuture
    def __init__(self, dim: _Optional[int] = ..., future: _Optional[_Union[TrueFuture, str]] = ...) -> None: ...

class Trained(_message.Message):
    __slots__ = ("action_horizons", "sub_steps", "missing", "sessions")
    ACTION_HORIZONS_FIELD_NUMBER: _ClassVar[int]
    SUB_STEPS_FIELD_NUMBER: _ClassVar[int]
    MISSING_FIELD_NUMBER: _ClassVar[int]
    SESSIONS_FIELD_NUMBER: _ClassVar[int]
    action_horizons: _containers.RepeatedScalarFieldContainer[int]
    sub_steps: _containers.RepeatedScalarFieldContainer[int]
    missing: Missing
    sessions: bool
    def __init__(self, action_horizons: _Optional[_Iterable[int]] = ..., sub_steps: _Optional[_Iterable[int]] = ..., missing: _Optional[_Union[Missing, _Mapping]] = ..., sessions: bool = ...) -> None: ...

class Missing(_message.Message):
    __slots__ = ("state", "action", "reward")
    STATE_FIELD_NUMBER: _ClassVar[int]
    ACTION_FIELD_NUMBER: _ClassVar[int]
    REWARD_FIELD_NUMBER: _ClassVar[int]
    state: bool
    action: bool
    reward: bool
    def __init__(self, state: bool = ..., action: bool = ..., reward: bool = ...) -> None: ...

class Vector(_message.Message):
    __slots__ = ("values",)
    VALUES_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, values: _Optional[_Iterable[float]] = ...) -> None: ...

class SamplerOptions(_message.Message):
    __slots__ = ("streaming", "action_horizon", "sub_steps", "eta", "temperature", "kappa", "latent", "guidance_scale", "guidance_samples", "free_guidance_scale", "told_return", "told_goal", "candidates", "pick_temperature", "picard_window", "picard_tolerance")
    STREAMING_FIELD_NUMBER: _ClassVar[int]
    ACTION_HORIZON_FIELD_NUMBER: _ClassVar[int]
    SUB_STEPS_FIELD_NUMBER: _ClassVar[int]
    ETA_FIELD_NUMBER: _ClassVar[int]
    TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    KAPPA_FIELD_NUMBER: _ClassVar[int]
    LATENT_FIELD_NUMBER: _ClassVar[int]
    GUIDANCE_SCALE_FIELD_NUMBER: _ClassVar[int]
    GUIDANCE_SAMPLES_FIELD_NUMBER: _ClassVar[int]
    FREE_GUIDANCE_SCALE_FIELD_NUMBER: _ClassVar[int]
    TOLD_RETURN_FIELD_NUMBER: _ClassVar[int]
    TOLD_GOAL_FIELD_NUMBER: _ClassVar[int]
    CANDIDATES_FIELD_NUMBER: _ClassVar[int]
    PICK_TEMPERATURE_FIELD_NUMBER: _ClassVar[int]
    PICARD_WINDOW_FIELD_NUMBER: _ClassVar[int]
    PICARD_TOLERANCE_FIELD_NUMBER: _ClassVar[int]
    streaming: bool
    action_horizon: int
    sub_steps: int
    eta: float
    temperature: float
    kappa: float
    latent: LatentMode
    guidance_scale: float
    guidance_samples: int
    free_guidance_scale: float
    told_return: float
    told_goal: Vector
    candidates: int
    pick_temperature: float
    picard_window: int
    picard_tolerance: float
    def __init__(self, streaming: bool = ..., action_horizon: _Optional[int] = ..., sub_steps: _Optional[int] = ..., eta: _Optional[float] = ..., temperature: _Optional[float] = ..., kappa: _Optional[float] = ..., latent: _Optional[_Union[LatentMode, str]] = ..., guidance_scale: _Optional[float] = ..., guidance_samples: _Optional[int] = ..., free_guidance_scale: _Optional[float] = ..., told_return: _Optional[float] = ..., told_goal: _Optional[_Union[Vector, _Mapping]] = ..., candidates: _Optional[int] = ..., pick_temperature: _Optional[float] = ..., picard_window: _Optional[int] = ..., picard_tolerance: _Optional[float] = ...) -> None: ...
