"""What can go wrong, one class for each thing a caller can do about it.

The server names every failure by a fixed word, the *reason* (table in `clients/http/README.md`). Both faces carry it, and
`from_detail` is the only place where it becomes a class. A failure without a reason (no connection, a proxy in between)
becomes the class of its gRPC code or HTTP status.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Detail:
    """What an answer says about a failure, the same from both faces."""

    message: str
    #: Fixed word to act on; empty when the server did not write this answer.
    reason: str = ""
    #: Path of the offending field, e.g. `observation.executed[2].action`.
    field: str = ""
    committed_step: int | None = None
    retry_after_ms: int | None = None
    #: With internal errors: find it in the server's log.
    error_id: str = ""


class AdaError(Exception):
    """Base of all errors of this package; the fields are those of `Detail`."""

    #: Whether the same request may succeed if it is sent again, unchanged.
    retryable = False
    #: The way on, where the server cannot know it; part of the text.
    cure = ""

    def __init__(self, detail: Detail | str) -> None:
        self.detail = Detail(detail) if isinstance(detail, str) else detail
        super().__init__(str(self))

    @property
    def reason(self) -> str:
        return self.detail.reason

    @property
    def message(self) -> str:
        return self.detail.message

    @property
    def field(self) -> str:
        return self.detail.field

    @property
    def committed_step(self) -> int | None:
        return self.detail.committed_step

    @property
    def retry_after_ms(self) -> int | None:
        return self.detail.retry_after_ms

    @property
    def error_id(self) -> str:
        return self.detail.error_id

    def __str__(self) -> str:
        # The server's own messages begin with the field, and hold the id, where there is one: each is named once.
        field = "" if self.message.startswith(self.field) else self.field
        error_id = "" if self.error_id in self.message else f"error id {self.error_id}"
        return ": ".join(part for part in (self.reason, field, self.message, error_id, self.cure) if part)

    def __reduce__(self) -> tuple[type[AdaError], tuple[Detail]]:
        return type(self), (self.detail,)


class InvalidInput(AdaError):
    """Correct `field` and send again. OBSERVATION_INVALID, REQUEST_INVALID, OPTIONS_INVALID."""


class TooLarge(AdaError):
    """Send less. TOO_LARGE."""


class NotFound(AdaError):
    """No such model, or no such session (`SessionGone`). MODEL_NOT_FOUND."""


class SessionGone(NotFound):
    """The session was closed, expired, made room for others, or ended with its server: open a new one.

    SESSION_NOT_FOUND, SESSION_EXPIRED, SESSION_EVICTED.
    """

    cure = "open a new session, or go on from an export of this one (client.import_session)"


class StateCorrupt(SessionGone):
    """What the server had kept of this session is damaged; all others go on. Report `error_id`. STATE_CORRUPT."""

    cure = "or go on from an export of it (client.import_session)"


class ModelGone(NotFound):
    """The checkpoint that the session began on is not served there: serve it again, or open a new session. MODEL_GONE."""


class StepConflict(AdaError):
    """Somebody else moved the session: go on by `session.catch_up()`. STEP_OUT_OF_ORDER, SESSION_BUSY, EPISODE_OVER."""


class TokenStale(StepConflict):
    """The session has gone on since the token was made: `client.attach(session_id)`. TOKEN_STALE."""


class TokenExpired(SessionGone):
    """The token is too old to go on from: open a new session. TOKEN_EXPIRED."""

    cure = "open a new session, or go on from a newer token of this one (client.resume)"


class PayloadMismatch(AdaError):
    """This step was taken with another observation, its answer was lost. STEP_PAYLOAD_MISMATCH."""

    cure = (
        "the answer of that act was lost; either act with its observation again, or call session.catch_up() and act with what was "
        "executed since then (nothing_executed=True if nothing was)"
    )


class Overloaded(AdaError):
    """The same again after `retry_after_ms`. QUEUE_FULL, QUOTA."""

    retryable = True


class StoreFull(AdaError):
    """The server has no room to keep this, so that nothing was changed: the same again once there is some. STORE_FULL."""

    cure = "make room for it (store.dir, store.bytes_max, store.len_max), or close sessions; then the same call again is done"


class DeadlineExceeded(AdaError):
    """The same again: it happens now, or gives the answer if it was committed meanwhile. DEADLINE_*, or this client's timeout."""

    retryable = True


class Unavailable(AdaError):
    """The same again after `retry_after_ms`: no connection, or DRAINING, NOT_READY, CONNECTIONS_FULL, STORE_UNAVAILABLE."""

    retryable = True


class Cancelled(AdaError):
    """The call was given up on this side before it was answered. CANCELLED."""


class ServerFault(AdaError):
    """Report `error_id`: nothing was changed. NONFINITE_OUTPUT, ENGINE_PANIC, INTERNAL."""


class PoisonStep(AdaError):
    """The server failed twice over this observation: act with another one, or reset the session. Report `error_id`. POISON_STEP."""


class UnexpectedAnswer(AdaError):
    """The answer is none that this server gives: wrong address, or a version that this client does not know."""


_BY_REASON: dict[str, type[AdaError]] = {
    "OBSERVATION_INVALID": InvalidInput,
    "REQUEST_INVALID": InvalidInput,
    "OPTIONS_INVALID": InvalidInput,
    "TOO_LARGE": TooLarge,
    "MODEL_NOT_FOUND": NotFound,
    "MODEL_GONE": ModelGone,
    "SESSION_NOT_FOUND": SessionGone,
    "SESSION_EXPIRED": SessionGone,
    "SESSION_EVICTED": SessionGone,
    "STATE_CORRUPT": StateCorrupt,
    "TOKEN_STALE": TokenStale,
    "TOKEN_EXPIRED": TokenExpired,
    "STEP_OUT_OF_ORDER": StepConflict,
    "SESSION_BUSY": StepConflict,
    "EPISODE_OVER": StepConflict,
    "STEP_PAYLOAD_MISMATCH": PayloadMismatch,
    "QUEUE_FULL": Overloaded,
    "QUOTA": Overloaded,
    "STORE_FULL": StoreFull,
    "DEADLINE_ADMISSION": DeadlineExceeded,
    "DEADLINE_QUEUE": DeadlineExceeded,
    "DEADLINE_COMPUTE": DeadlineExceeded,
    "CANCELLED": Cancelled,
    "DRAINING": Unavailable,
    "NOT_READY": Unavailable,
    "CONNECTIONS_FULL": Unavailable,
    "STORE_UNAVAILABLE": Unavailable,
    "NONFINITE_OUTPUT": ServerFault,
    "ENGINE_PANIC": ServerFault,
    "INTERNAL": ServerFault,
    "POISON_STEP": PoisonStep,
}

_BY_GRPC_CODE: dict[int, type[AdaError]] = {
    1: Cancelled,
    3: InvalidInput,
    4: DeadlineExceeded,
    5: NotFound,
    8: Overloaded,
    9: PayloadMismatch,
    10: StepConflict,
    13: ServerFault,
    14: Unavailable,
    15: ServerFault,
}

_BY_HTTP_STATUS: dict[int, type[AdaError]] = {
    400: InvalidInput,
    404: NotFound,
    408: DeadlineExceeded,
    410: SessionGone,
    413: TooLarge,
    414: TooLarge,
    429: Overloaded,
    431: TooLarge,
    500: ServerFault,
    502: Unavailable,
    503: Unavailable,
    504: DeadlineExceeded,
    507: StoreFull,
}


def from_detail(detail: Detail, *, grpc_code: int | None = None, http_status: int | None = None) -> AdaError:
    """The error of a failed call: by its reason, else by its code or status."""
    kind = _BY_REASON.get(detail.reason)
    if kind is None and grpc_code is not None:
        kind = _BY_GRPC_CODE.get(grpc_code)
    if kind is None and http_status is not None:
        kind = _BY_HTTP_STATUS.get(http_status)
    return (kind or UnexpectedAnswer)(detail)
