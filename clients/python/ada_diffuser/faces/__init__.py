"""The two faces of the server, behind one protocol: every verb once, plain data in and out, `AdaError` on failure.

A face makes exactly one attempt a call, with values that are checked already; both are the client's business.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol
from urllib.parse import urlsplit

from ada_diffuser.errors import AdaError
from ada_diffuser.messages import ActCall, Chunk, ForkCall, Model, OpenCall, SessionSummary


class Face(Protocol):
    """The verbs. `timeout_s` bounds each call on this side, from the connecting to the last byte of the answer."""

    def open_session(self, call: OpenCall, timeout_s: float) -> tuple[SessionSummary, Model]: ...

    def act(self, call: ActCall, timeout_s: float) -> Chunk: ...

    def act_batch(self, calls: Sequence[ActCall], timeout_s: float) -> list[Chunk | AdaError]: ...

    def reset_session(
        self, session_id: str, seed: int | None, keep_history: bool, request_id: str, episode: int, timeout_s: float
    ) -> SessionSummary: ...

    def get_session(self, session_id: str, timeout_s: float) -> SessionSummary: ...

    def list_sessions(self, model: str, page_size: int, page_token: str, timeout_s: float) -> tuple[list[SessionSummary], str]: ...

    def export_session(self, session_id: str, timeout_s: float) -> bytes: ...

    def import_session(self, record: bytes, ttl_ms: int | None, request_id: str, timeout_s: float) -> tuple[SessionSummary, Model]: ...

    def seal_session(self, session_id: str, timeout_s: float) -> bytes: ...

    def resume_session(self, token: bytes, timeout_s: float) -> tuple[SessionSummary, Model]: ...

    def fork_session(self, call: ForkCall, timeout_s: float) -> tuple[SessionSummary, Model]: ...

    def close_session(self, session_id: str, timeout_s: float) -> None: ...

    def models(self, timeout_s: float) -> list[Model]: ...

    def model(self, name: str, timeout_s: float) -> Model: ...

    def close(self) -> None: ...


def connect(url: str) -> Face:
    """The face that `url` names: `grpc://host:port` or `http://host:port`. No byte is sent yet."""
    parts = urlsplit(url)
    if parts.scheme not in ("grpc", "http") or not parts.hostname or parts.port is None:
        raise ValueError(f"{url!r} is neither grpc://host:port nor http://host:port")
    if parts.path.strip("/") or parts.query or parts.fragment:
        raise ValueError(f"{url!r} has more than a host and a port")
    if parts.scheme == "grpc":
        from ada_diffuser.faces.grpc_face import GrpcFace
        from ada_diffuser.faces.proxy import proxy_to

        return GrpcFace(parts.netloc, proxy_to(parts.hostname))
    from ada_diffuser.faces.http_face import HttpFace

    return HttpFace(parts.hostname, parts.port)
