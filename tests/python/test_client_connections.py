"""What the REST face does with its connections: each request once, on one that stands in step, its answer whole and in time."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress

import pytest
from fake_server import MODEL, Core, serving

from ada_diffuser import Client, DeadlineExceeded, RetryPolicy, TooLarge, Unavailable, UnexpectedAnswer

ONCE = RetryPolicy(attempts=1)
MODELS = json.dumps({"models": [MODEL]}).encode()
TOO_LARGE = b'{"status": 413, "reason": "TOO_LARGE", "detail": "bytes of a message exceeds 7"}'


class Visits:
    """A server by hand: for each request, the number of the connection that it came on; `answer` says what goes back."""

    def __init__(self, answer: Callable[[socket.socket, int], None]) -> None:
        self.heard: list[int] = []
        self._answer = answer
        self._visitors = 0
        self._lock = threading.Lock()

    def serve(self, listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                visitor, _ = listener.accept()
                self._visitors += 1
                threading.Thread(target=self._talk, args=(visitor, self._visitors), daemon=True).start()

    def _talk(self, visitor: socket.socket, number: int) -> None:
        with visitor, suppress(OSError, EOFError):
            while True:
                _read_head(visitor)
                with self._lock:
                    self.heard.append(number)
                    count = len(self.heard)
                self._answer(visitor, count)


def _read_head(visitor: socket.socket) -> None:
    said = b""
    while b"\r\n\r\n" not in said:
        more = visitor.recv(1)
        if not more:
            raise EOFError
        said += more


@contextmanager
def visited(answer: Callable[[socket.socket, int], None]) -> Iterator[tuple[str, list[int]]]:
    visits = Visits(answer)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=visits.serve, args=(listener,), daemon=True).start()
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", visits.heard
        listener.shutdown(socket.SHUT_RDWR)


def _say(visitor: socket.socket, body: bytes, status: bytes = b"200 OK", head: bytes = b"") -> None:
    visitor.sendall(b"HTTP/1.1 %s\r\nContent-Length: %d\r\n%s\r\n%s" % (status, len(body), head, body))


def test_a_request_whose_answer_is_lost_is_not_repeated_below_the_clients_own_rules() -> None:
    """On a connection that was kept many libraries send it again by themselves."""

    def answer(visitor: socket.socket, count: int) -> None:
        if count == 1:
            return _say(visitor, MODELS)
        raise EOFError

    with visited(answer) as (url, heard), Client(url, retry=ONCE) as client:
        client.models()
        with pytest.raises(Unavailable):
            client.models()
        assert heard == [1, 1]


@pytest.mark.parametrize("status", [b"302 Found", b"307 Temporary Redirect", b"503 Service Unavailable"])
def test_neither_a_redirect_nor_a_wish_is_followed_below_the_clients_own_rules(status: bytes) -> None:
    def answer(visitor: socket.socket, count: int) -> None:
        _say(visitor, b"", status, b"Location: /v1/elsewhere\r\nRetry-After: 0\r\n")

    with visited(answer) as (url, heard), Client(url, retry=ONCE) as client:
        with pytest.raises((UnexpectedAnswer, Unavailable)):
            client.models()
        assert len(heard) == 1


def test_a_connection_is_used_again_and_not_one_that_the_server_has_closed() -> None:
    closed = threading.Event()

    def answer(visitor: socket.socket, count: int) -> None:
        _say(visitor, MODELS)
        if count == 2:
            visitor.shutdown(socket.SHUT_RDWR)
            closed.set()

    with visited(answer) as (url, heard), Client(url, retry=ONCE) as client:
        client.models()
        client.models()
        assert closed.wait(5)
        client.models()
        assert heard == [1, 1, 2]


def test_a_connection_on_which_a_body_is_still_due_is_not_used_again() -> None:
    """The server took the next request for the body that it had refused."""

    def answer(visitor: socket.socket, count: int) -> None:
        _say(visitor, MODELS if count > 1 else TOO_LARGE, b"200 OK" if count > 1 else b"413 Payload Too Large")

    with visited(answer) as (url, heard), Client(url, retry=ONCE) as client:
        with pytest.raises(TooLarge):
            client.open_session("m" * 1_000_000)
        client.models()
        assert heard == [1, 2]


def test_a_body_that_nobody_takes_in_time_is_a_deadline() -> None:
    def answer(visitor: socket.socket, count: int) -> None:
        time.sleep(5)
        raise EOFError

    with visited(answer) as (url, heard), Client(url, timeout_s=1.5, retry=ONCE) as client:
        started = time.monotonic()
        with pytest.raises(DeadlineExceeded):
            client.open_session("m" * 30_000_000)
        assert time.monotonic() - started < 3 and heard == [1]


def test_an_answer_in_pieces_is_whole() -> None:
    def answer(visitor: socket.socket, count: int) -> None:
        pieces = b"".join(b"%x\r\n%s\r\n" % (len(MODELS[i : i + 7]), MODELS[i : i + 7]) for i in range(0, len(MODELS), 7))
        visitor.sendall(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + pieces + b"0\r\n\r\n")

    with visited(answer) as (url, heard), Client(url, retry=ONCE) as client:
        assert [client.models()[0].name for _ in range(2)] == ["fake", "fake"]
        assert heard == [1, 1]


def test_an_answer_that_breaks_off_is_none() -> None:
    def answer(visitor: socket.socket, count: int) -> None:
        visitor.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%s" % (len(MODELS) + 9, MODELS))
        raise EOFError

    with visited(answer) as (url, heard), Client(url, retry=ONCE) as client:
        with pytest.raises(Unavailable):
            client.models()
        assert len(heard) == 1


def test_many_threads_share_a_client() -> None:
    core = Core()
    with serving(core, "http") as url, Client(url, retry=ONCE) as client:

        def drive(number: int) -> list[float]:
            session = client.open_session()
            return [float(session.act([number, step]).actions[0, 1]) for step in range(20)]

        with ThreadPoolExecutor(4) as threads:  # more at once than 5 do not find room in the double's queue of visitors
            assert list(threads.map(drive, range(16))) == [[number] * 20 for number in range(16)]
        assert len(core.seen) == 16 * 20
