"""What lies between the client and the server: proxies of the environment, servers that keep silent, bodies that are too large."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from fake_server import Core, serving

from ada_diffuser import Client, DeadlineExceeded, RetryPolicy, TooLarge, Unavailable
from ada_diffuser.faces.proxy import Proxy, proxy_to

FACES = ("grpc", "http")
ONCE = RetryPolicy(attempts=1)
NOBODY = "http://me:secret@127.0.0.1:9"
VARIABLES = ("grpc_proxy", "https_proxy", "http_proxy", "no_grpc_proxy", "no_proxy")


@pytest.fixture(autouse=True)
def no_proxies(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in VARIABLES:
        monkeypatch.delenv(variable, raising=False)


@contextmanager
def answering(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """The port of a server that does only this with whoever comes."""

    def one(visitor: socket.socket) -> None:
        with visitor, suppress(OSError):
            answer(visitor)

    def accept() -> None:
        with suppress(OSError):
            while True:
                threading.Thread(target=one, args=(listener.accept()[0],), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=accept, daemon=True).start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)


@pytest.mark.parametrize("variable", ["grpc_proxy", "https_proxy", "http_proxy"])
@pytest.mark.parametrize("face", FACES)
def test_this_machine_is_reached_without_a_proxy(face: str, variable: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a company's machine gRPC asked the company's proxy for 127.0.0.1, and failed; REST did not."""
    monkeypatch.setenv(variable, NOBODY)
    with serving(Core(), face) as url:
        for there in (url, url.replace("127.0.0.1", "localhost")):
            with Client(there, retry=ONCE) as client:
                assert client.models()


def test_an_error_names_the_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error spoke of the proxy's address as if the server stood there, and not of the variable that named it."""
    monkeypatch.setenv("http_proxy", NOBODY)
    with Client("grpc://ada.invalid:80", retry=ONCE) as client, pytest.raises(Unavailable) as caught:
        client.models()
    assert "proxy 127.0.0.1:9 of the environment's http_proxy" in str(caught.value)
    assert "secret" not in str(caught.value)


def test_which_proxy_is_taken_to_which_host(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://web:3128")
    monkeypatch.setenv("https_proxy", "http://safe:3128")
    assert proxy_to("ada.example") == Proxy("https_proxy", "safe:3128")
    assert all(proxy_to(host) is None for host in ("127.0.0.1", "127.8.9.1", "::1", "localhost", "LOCALHOST"))
    monkeypatch.setenv("no_proxy", "other.example, 10.0.0.0/8, .lab.example")
    assert proxy_to("ada.example") == proxy_to("11.2.3.4") == Proxy("https_proxy", "safe:3128")
    assert all(proxy_to(host) is None for host in ("10.2.3.4", "gpu.lab.example", "other.example"))
    monkeypatch.setenv("no_proxy", "*")
    assert proxy_to("ada.example") is None
    monkeypatch.setenv("no_grpc_proxy", "other.example")
    monkeypatch.setenv("grpc_proxy", "socks5://tunnel:1080")
    assert proxy_to("ada.example") is None, "gRPC passes over what is no http:// proxy"


@pytest.mark.parametrize("face", FACES)
def test_no_answer_in_time_is_a_deadline(face: str) -> None:
    """Over gRPC a connection had a fifth of a second to stand, whatever the timeout, and was then Unavailable."""
    with answering(lambda visitor: time.sleep(5)) as port, Client(f"{face}://127.0.0.1:{port}", timeout_s=1.0, retry=ONCE) as client:
        started = time.monotonic()
        with pytest.raises(DeadlineExceeded):
            client.models()
        assert 0.9 < time.monotonic() - started < 2


@pytest.mark.parametrize("part", ["head", "body"])
def test_an_answer_that_drips_in_does_not_outlast_the_timeout(part: str) -> None:
    """Over REST the timeout bounded each wait for some bytes, not the call: an answer of a few bytes at a time could take for ever."""

    def drip(visitor: socket.socket) -> None:
        visitor.recv(65536)
        visitor.sendall(b"HTTP/1.1 200 OK\r\n" + (b"Content-Length: 1000000\r\n\r\n" if part == "body" else b""))
        for _ in range(80):
            visitor.sendall(b"x: y\r\n")
            time.sleep(0.05)

    with answering(drip) as port, Client(f"http://127.0.0.1:{port}", timeout_s=0.5, retry=ONCE) as client:
        started = time.monotonic()
        with pytest.raises(DeadlineExceeded):
            client.models()
        assert time.monotonic() - started < 1.5


@pytest.mark.parametrize("timeout_s", [0, -1, float("nan"), float("inf")])
def test_a_timeout_is_a_time(timeout_s: float) -> None:
    with pytest.raises(ValueError, match="timeout_s"):
        Client("http://127.0.0.1:1", timeout_s=timeout_s)


@pytest.mark.parametrize("face", FACES)
def test_a_body_that_is_too_large_is_sent_once_and_says_so(address: str, face: str) -> None:
    """Over REST a server answers 413 and hangs up while the body is being sent: the client saw a broken pipe, and sent it six times."""
    policy = RetryPolicy(base_s=30.0, cap_s=30.0)
    with Client(f"{face}://{address}", retry=policy) as client, client.open_session() as session:
        started = time.monotonic()
        with pytest.raises(TooLarge):
            session.act(np.zeros(2_000_000))
        assert time.monotonic() - started < 15, "no wait before a second time"
        assert session.act(np.zeros(4)).step == 1


def _until(visitor: socket.socket, end: bytes) -> bytes:
    """What comes until then."""
    said = b""
    while not said.endswith(end):
        said += visitor.recv(65536)
    return said


PROBLEM = b'{"status": 413, "reason": "TOO_LARGE", "detail": "bytes of a message exceeds 7"}'


def test_a_large_body_is_announced_and_not_sent_to_whoever_refuses_it() -> None:
    """Megabytes went to a server that had refused them at their first header, and where the connection broke they went six times."""
    heard: list[bytes] = []

    def refuse(visitor: socket.socket) -> None:
        heard.append(_until(visitor, b"\r\n\r\n"))
        visitor.sendall(b"HTTP/1.1 413 Payload Too Large\r\nContent-Length: %d\r\n\r\n%s" % (len(PROBLEM), PROBLEM))
        while more := visitor.recv(65536):
            heard.append(more)

    with answering(refuse) as port, Client(f"http://127.0.0.1:{port}", timeout_s=5.0) as client, pytest.raises(TooLarge):
        client.open_session("m" * 1_000_000)
    assert len(heard) == 1 and b"expect: 100-continue" in heard[0].lower(), [said[:200] for said in heard]


@pytest.mark.parametrize("goes_on", [b"HTTP/1.1 100 Continue\r\n\r\n", b""])
def test_a_large_body_is_sent_to_whoever_wants_it(goes_on: bytes) -> None:
    heard: list[bytes] = []

    def listen(visitor: socket.socket) -> None:
        _until(visitor, b"\r\n\r\n")
        visitor.sendall(goes_on)
        heard.append(_until(visitor, b'"}'))
        visitor.sendall(b"HTTP/1.1 413 Payload Too Large\r\nContent-Length: %d\r\n\r\n%s" % (len(PROBLEM), PROBLEM))

    with answering(listen) as port, Client(f"http://127.0.0.1:{port}", timeout_s=5.0) as client, pytest.raises(TooLarge):
        client.open_session("m" * 1_000_000)
    assert len(heard) == 1 and heard[0].count(b"m" * 1_000_000) == 1


def test_a_real_batch_beyond_the_limit(address: str) -> None:
    """260 acts were TooLarge: 'number of acts exceeds 256'."""
    with Client(f"http://{address}") as client:
        sessions = [client.open_session(seed=1) for _ in range(260)]
        answers = client.act_batch(sessions, np.zeros((260, 4)))
        assert len({answer.actions.tobytes() for answer in answers}) == 1  # type: ignore[union-attr]
        for session in sessions:
            session.close()
