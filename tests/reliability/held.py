"""Connections that are held for nothing, of every shape: what they cost the server, what they cost others, and when they end."""

from __future__ import annotations

import base64
import json
import os
import select
import socket
import statistics
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from .newcomer import HALF_BODY, PREFACE, SETTINGS
from .process import MB, Row, Server, load, open_files_max, report

HELD = 1000
TURNS, SECONDS = 3, 3
#: So long they are held, while others act.
LIMIT_MS = 12_000
#: The server looks at its connections from time to time, and cuts some who were asked to leave and did not.
ENDED_S = 40.0
LIMITS = (
    "preface_timeout_ms",
    "header_read_timeout_ms",
    "body_read_timeout_ms",
    "write_timeout_ms",
    "idle_timeout_ms",
    "keepalive_timeout_ms",
)


def measure() -> Iterator[Row]:
    open_files_max()
    shapes: dict[str, Callable[[Server], bytes]] = {
        "silent": lambda _: b"",
        "half a header": lambda _: b"GET /livez HTTP/1.1\r\nhost: local",
        "half a body": lambda _: HALF_BODY,
        "HTTP/2 without a request": lambda _: PREFACE + SETTINGS,
        "WebSockets without an act": _upgrade,
    }
    for shape, words in shapes.items():
        with Server("models.default=tiny", *(f"connection.{name}={LIMIT_MS}" for name in LIMITS)) as server:
            said = words(server)
            before = [report(_honest(server)) for _ in range(TURNS)]
            rss, begin = server.memory(), time.monotonic()
            held = [_connect(server.port, said) for _ in range(HELD)]
            beside, most = [], 0.0
            for _ in range(TURNS):
                honest = _honest(server)
                while honest.poll() is None:
                    most = max(most, server.memory())
                    time.sleep(0.05)
                beside.append(report(honest))
            case = f"{HELD} connections, {shape}: "
            yield Row("held", f"{case}memory", (most - rss) / MB, 32, "MB")
            yield Row("held", f"{case}p99 of others to before", _p99(beside) / _p99(before), 2, "")
            yield Row("held", f"{case}acts of others that failed", sum(sum(one["errors"].values()) for one in beside), 0, "acts")
            yield Row("held", f"{case}until all are closed", _until_closed(held, begin), ENDED_S, "s")


def _p99(turns: list[dict[str, Any]]) -> float:
    """Of the turns' the median: one hiccup of the machine is in one of them."""
    return statistics.median(turn["latency_ms"]["p99"] for turn in turns)


def _honest(server: Server) -> subprocess.Popen[str]:
    return load(server, "--model", "tiny", "--clients", 4, "--rate", 400, "--seconds", SECONDS, "--warm-up", 0.2)


def _upgrade(server: Server) -> bytes:
    """The head of a WebSocket on a session of its own."""
    head = {"content-type": "application/json"}
    request = urllib.request.Request(f"{server.url}/v1/sessions", b'{"model": "tiny"}', head)
    session = json.load(urllib.request.urlopen(request))["session"]["session_id"]
    key = base64.b64encode(os.urandom(16)).decode()
    words = f"upgrade: websocket\r\nconnection: upgrade\r\nsec-websocket-version: 13\r\nsec-websocket-key: {key}\r\n\r\n"
    return f"GET /v1/sessions/{session}/stream HTTP/1.1\r\nhost: localhost\r\n{words}".encode()


def _connect(port: int, words: bytes) -> socket.socket:
    held = socket.create_connection(("127.0.0.1", port), timeout=10)
    held.sendall(words)
    held.setblocking(False)
    return held


def _until_closed(held: list[socket.socket], begin: float) -> float:
    """Seconds from then until the server has closed all of them, whatever it says before; twice the bound if it does not."""
    poll = select.poll()
    open_ones = {one.fileno(): one for one in held}
    for one in open_ones:
        poll.register(one, select.POLLIN)
    while open_ones and time.monotonic() - begin < 2 * ENDED_S:
        for number, _ in poll.poll(500):
            with suppress(BlockingIOError):
                if _has_ended(open_ones[number]):
                    poll.unregister(number)
                    open_ones.pop(number).close()
    took = time.monotonic() - begin
    for one in open_ones.values():
        one.close()
    return took


def _has_ended(one: socket.socket) -> bool:
    try:
        return not one.recv(65536)
    except ConnectionError:
        return True
