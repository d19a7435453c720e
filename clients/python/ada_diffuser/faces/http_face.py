"""The REST face: JSON <-> plain data, over kept-alive connections of the standard library.

Why its own pool, and not urllib3's (tried with 2.8): what is long here would stay. urllib3 bounds each wait for bytes and not the whole
answer, and sends a body that says `Expect: 100-continue` without waiting to be asked for it. Both can be put in by overriding three methods
of its connection, one of which has to raise BrokenPipeError to make it read the answer to a body that was refused. That passes the same
tests, is 27 lines shorter, needs one package more, and does 0.77 times as many acts a second (one client, `models/tiny`, in turns with
this one in one process): a call takes half as much CPU time again.
"""

from __future__ import annotations

import http.client
import io
import json
import socket
import threading
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any
from urllib.parse import quote, urlencode

from ada_diffuser.errors import AdaError, DeadlineExceeded, Detail, Unavailable, UnexpectedAnswer, from_detail
from ada_diffuser.faces import http_json
from ada_diffuser.faces.liveness import CONNECT_S, PROOF_S, SILENT_S
from ada_diffuser.messages import ActCall, Chunk, ForkCall, Model, OpenCall, SessionSummary

#: A longer body is announced before it is sent: a server that finds it too large says so, and need not be sent all of it.
_ANNOUNCED_LEN = 256 * 1024
#: Who does not answer that in so long does not know how to.
_ANNOUNCED_S = 1.0
_CONTINUE = b"HTTP/1.1 100"
#: What the kernel is asked to do about a silent peer, by the names that it knows; the last is also of bytes that nobody acknowledges.
_LIVENESS = {
    "TCP_KEEPIDLE": int(SILENT_S),
    "TCP_KEEPINTVL": int(PROOF_S),
    "TCP_KEEPCNT": 1,
    "TCP_USER_TIMEOUT": int((SILENT_S + PROOF_S) * 1000),
}


class HttpFace:
    """A pool of connections, one for each call under way; safe to use from many threads."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port
        self._idle: list[http.client.HTTPConnection] = []
        self._closed = False
        self._lock = threading.Lock()

    def open_session(self, call: OpenCall, timeout_s: float) -> tuple[SessionSummary, Model]:
        return _opened(self._call("POST", "/v1/sessions", http_json.open_body(call), timeout_s))

    def export_session(self, session_id: str, timeout_s: float) -> bytes:
        answer = self._call("GET", f"/v1/sessions/{_quoted(session_id)}/export", None, timeout_s)
        return http_json.read(http_json.binary, answer, "record")

    def import_session(self, record: bytes, ttl_ms: int | None, request_id: str, timeout_s: float) -> tuple[SessionSummary, Model]:
        body = http_json.without_none(record=http_json.binary_out(record), ttl_ms=ttl_ms, request_id=request_id)
        return _opened(self._call("POST", "/v1/sessions:import", body, timeout_s))

    def seal_session(self, session_id: str, timeout_s: float) -> bytes:
        answer = self._call("POST", f"/v1/sessions/{_quoted(session_id)}/seal", None, timeout_s)
        return http_json.read(http_json.binary, answer, "token")

    def resume_session(self, token: bytes, timeout_s: float) -> tuple[SessionSummary, Model]:
        return _opened(self._call("POST", "/v1/sessions:resume", {"token": http_json.binary_out(token)}, timeout_s))

    def fork_session(self, call: ForkCall, timeout_s: float) -> tuple[SessionSummary, Model]:
        body = http_json.without_none(seed=call.seed, ttl_ms=call.ttl_ms, request_id=call.request_id, step=call.step, episode=call.episode)
        return _opened(self._call("POST", f"/v1/sessions/{_quoted(call.session_id)}/fork", body, timeout_s))

    def act(self, call: ActCall, timeout_s: float) -> Chunk:
        body = http_json.act_body(call)
        return http_json.read(http_json.chunk, self._call("POST", f"/v1/sessions/{_quoted(call.session_id)}/act", body, timeout_s))

    def act_batch(self, calls: Sequence[ActCall], timeout_s: float) -> list[Chunk | AdaError]:
        body = {"acts": [{"session_id": call.session_id, **http_json.act_body(call)} for call in calls]}
        return http_json.read(http_json.results, self._call("POST", "/v1/act:batch", body, timeout_s), "results")

    def reset_session(
        self, session_id: str, seed: int | None, keep_history: bool, request_id: str, episode: int, timeout_s: float
    ) -> SessionSummary:
        path = f"/v1/sessions/{_quoted(session_id)}/reset"
        body = http_json.without_none(seed=seed, keep_history=keep_history or None, request_id=request_id, episode=episode)
        return http_json.read(http_json.summary, self._call("POST", path, body, timeout_s), "session")

    def get_session(self, session_id: str, timeout_s: float) -> SessionSummary:
        return http_json.read(http_json.summary, self._call("GET", f"/v1/sessions/{_quoted(session_id)}", None, timeout_s), "session")

    def list_sessions(self, model: str, page_size: int, page_token: str, timeout_s: float) -> tuple[list[SessionSummary], str]:
        wanted = http_json.without_none(model=model or None, page_size=page_size or None, page_token=page_token or None)
        answer = self._call("GET", "/v1/sessions?" + urlencode({"view": "full", **wanted}), None, timeout_s)
        sessions = http_json.read(lambda listed: [http_json.summary({"session_id": "", **one}) for one in listed], answer, "sessions")
        return sessions, http_json.read(str, answer, "next_page_token")

    def close_session(self, session_id: str, timeout_s: float) -> None:
        self._call("DELETE", f"/v1/sessions/{_quoted(session_id)}", None, timeout_s)

    def models(self, timeout_s: float) -> list[Model]:
        answer = self._call("GET", "/v1/models", None, timeout_s)
        return http_json.read(lambda models: [http_json.model(model) for model in models], answer, "models")

    def model(self, name: str, timeout_s: float) -> Model:
        if not name:  # an empty name has no path of its own: the default model is marked in the list
            models = [model for model in self.models(timeout_s) if model.is_default]
            if not models:
                raise from_detail(Detail("the server has no default model", "MODEL_NOT_FOUND"))
            return models[0]
        return http_json.read(http_json.model, self._call("GET", f"/v1/models/{_quoted(name)}", None, timeout_s), "model")

    def close(self) -> None:
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
        for connection in idle:
            connection.close()

    def _call(self, method: str, path: str, body: Mapping[str, Any] | None, timeout_s: float) -> Any:
        status, headers, text = self._exchange(method, path, body, timeout_s)
        if status == 204:
            return None
        try:
            answer = json.loads(text)
        except ValueError:
            answer = None
        if 200 <= status < 300 and isinstance(answer, dict):
            return answer
        if isinstance(answer, dict):
            raise http_json.error_of_problem(answer, status)
        after_s = headers.get("Retry-After", "")
        detail = Detail(
            f"status {status} from {self._host}:{self._port}, and no JSON object",
            retry_after_ms=int(after_s) * 1000 if after_s.isdigit() else None,
        )
        raise UnexpectedAnswer(detail) if status < 300 else from_detail(detail, http_status=status)

    def _exchange(
        self, method: str, path: str, body: Mapping[str, Any] | None, timeout_s: float
    ) -> tuple[int, http.client.HTTPMessage, bytes]:
        """One request and its whole answer. A connection that failed is not used again."""
        end = time.monotonic() + timeout_s
        connection = self._take()
        payload = None if body is None else json.dumps(body, separators=(",", ":"), allow_nan=False).encode()
        headers = {"Accept": "application/json"}
        if payload is not None:
            headers["Content-Type"] = "application/json"
        try:
            if connection.sock is None:
                _connect(connection, timeout_s)
            connection.sock.settimeout(_left(end))
            connection.response_class = partial(_Response, end=end)
            sent = _send(connection, method, path, payload, headers, end)
            response = connection.getresponse()
            text = response.read()
        except (OSError, http.client.HTTPException) as error:
            connection.close()
            # With a number it is the kernel's, of a peer that is gone, and not of the time that the call had.
            if isinstance(error, TimeoutError) and error.errno is None:
                raise DeadlineExceeded(f"no answer from {self._host}:{self._port} within {timeout_s:g} s") from None
            raise Unavailable(f"{self._host}:{self._port}: {error or type(error).__name__}") from None
        with self._lock:
            kept = sent and not (response.will_close or self._closed)
            if kept:
                self._idle.append(connection)
        if not kept:
            connection.close()
        return response.status, response.headers, text

    def _take(self) -> http.client.HTTPConnection:
        """An idle connection that the server has not closed meanwhile, or a new one."""
        while True:
            with self._lock:
                if not self._idle:
                    return http.client.HTTPConnection(self._host, self._port)
                connection = self._idle.pop()
            if connection.sock is not None and _is_alive(connection.sock):
                return connection
            connection.close()


def _connect(connection: http.client.HTTPConnection, timeout_s: float) -> None:
    """Within the timeout of the call, or what a connection may take; then the peer is watched."""
    connection.timeout = min(timeout_s, CONNECT_S)
    try:
        connection.connect()
    except TimeoutError as error:
        if timeout_s <= CONNECT_S or error.errno is not None:
            raise
        raise ConnectionError(f"no connection within {CONNECT_S:g} s") from None
    connection.sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _LIVENESS.items():
        if hasattr(socket, name):
            connection.sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


def _send(
    connection: http.client.HTTPConnection, method: str, path: str, payload: bytes | None, headers: Mapping[str, str], end: float
) -> bool:
    """Whether all of it was sent; if not, the answer that says why (it is too large, mostly) should be there."""
    try:
        if payload is None or len(payload) <= _ANNOUNCED_LEN:
            connection.request(method, path, payload, headers)
            return True
        connection.putrequest(method, path)
        for name, value in {**headers, "Content-Length": str(len(payload)), "Expect": "100-continue"}.items():
            connection.putheader(name, value)
        connection.endheaders()
        if not _is_wanted(connection.sock, end):
            return False
        connection.send(payload)
        return True
    except (BrokenPipeError, ConnectionResetError):
        return False


def _is_wanted(sock: socket.socket, end: float) -> bool:
    """Whether the server goes on to listen, or says nothing about it."""
    sock.settimeout(min(_ANNOUNCED_S, _left(end)))
    try:
        said = sock.recv(len(_CONTINUE), socket.MSG_PEEK)
    except TimeoutError:
        return True
    finally:
        sock.settimeout(_left(end))
    return bool(said) and _CONTINUE.startswith(said)


class _Response(http.client.HTTPResponse):
    """An answer that has to be read by `end`: the standard library only bounds the wait for its next bytes."""

    def __init__(self, sock: socket.socket, *, end: float, **settings: Any) -> None:
        super().__init__(sock, **settings)
        self.fp = io.BufferedReader(_Bounded(self.fp.detach(), sock, end))


class _Bounded(io.RawIOBase):
    """What the server sends, as long as there is time."""

    def __init__(self, raw: io.RawIOBase, sock: socket.socket, end: float) -> None:
        self._raw, self._sock, self._end = raw, sock, end

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        self._sock.settimeout(_left(self._end))
        return self._raw.readinto(buffer)  # type: ignore[attr-defined]

    def close(self) -> None:
        self._raw.close()
        super().close()


def _left(end: float) -> float:
    """Seconds until `end`, for a socket, to which 0 would mean another thing; TimeoutError if there are none."""
    left_s = end - time.monotonic()
    if left_s <= 0:
        raise TimeoutError
    return left_s


def _is_alive(idle: socket.socket) -> bool:
    """Nothing is due on an idle connection: if there is something to read, it is the end."""
    idle.setblocking(False)
    try:
        idle.recv(1, socket.MSG_PEEK)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _opened(answer: Any) -> tuple[SessionSummary, Model]:
    return http_json.read(http_json.summary, answer, "session"), http_json.read(http_json.model, answer, "model")


def _quoted(word: str) -> str:
    return quote(word, safe="@")
