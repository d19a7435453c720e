"""Python side of Ada-Diffuser: client, environments, data collection, evaluation.

`Client` and what it speaks of stand here; the rest is in the modules of those names and needs `ada-diffuser[mujoco]`, or for
`ada_diffuser.importing` `ada-diffuser[import]`.
"""

from ada_diffuser.broker import ChunkBroker
from ada_diffuser.client import Client
from ada_diffuser.errors import (
    AdaError,
    Cancelled,
    DeadlineExceeded,
    InvalidInput,
    ModelGone,
    NotFound,
    Overloaded,
    PayloadMismatch,
    PoisonStep,
    ServerFault,
    SessionGone,
    StateCorrupt,
    StepConflict,
    StoreFull,
    TokenExpired,
    TokenStale,
    TooLarge,
    Unavailable,
    UnexpectedAnswer,
)
from ada_diffuser.messages import (
    Chunk,
    Executed,
    Missing,
    Model,
    Observation,
    Returns,
    SamplerOptions,
    SessionSummary,
    Timings,
    Told,
    Trained,
    TrueContext,
)
from ada_diffuser.retry import RetryPolicy
from ada_diffuser.session import Session

__version__ = "0.1.0"

__all__ = [
    "AdaError",
    "Cancelled",
    "Chunk",
    "ChunkBroker",
    "Client",
    "DeadlineExceeded",
    "Executed",
    "InvalidInput",
    "Missing",
    "Model",
    "ModelGone",
    "NotFound",
    "Observation",
    "Overloaded",
    "PayloadMismatch",
    "PoisonStep",
    "RetryPolicy",
    "Returns",
    "SamplerOptions",
    "ServerFault",
    "Session",
    "SessionGone",
    "SessionSummary",
    "StateCorrupt",
    "StepConflict",
    "StoreFull",
    "Timings",
    "TokenExpired",
    "TokenStale",
    "Told",
    "TooLarge",
    "Trained",
    "TrueContext",
    "Unavailable",
    "UnexpectedAnswer",
]
