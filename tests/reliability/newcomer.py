"""Attackers who only hold connections, and somebody from another address who comes while they do."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

from .process import Row, Server, open_files_max

ATTACKERS = 4096
#: `server.connections_per_address_max`, but for those that the server has closed by then.
HELD = 2000
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
SETTINGS = b"\x00\x00\x00\x04\x00\x00\x00\x00\x00"
HALF_BODY = b"POST /v1/sessions HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: 1000\r\n\r\n{"
KINDS = {
    "silent ones": b"",
    "half a header": b"GET /livez HTTP/1.1\r\nhost: local",
    "half a body": HALF_BODY,
    "HTTP/2 and nothing asked, pings answered": PREFACE + SETTINGS,
}


def measure() -> Iterator[Row]:
    open_files_max()
    for kind, words in KINDS.items():
        with Server("models.default=tiny") as server:
            held = [_connect(server.port, words) for _ in range(ATTACKERS)]
            over = threading.Event()
            pinged = threading.Thread(target=_answer_pings, args=(held, over))
            if words.startswith(PREFACE):
                pinged.start()
            time.sleep(0.5)
            yield Row(
                "newcomer", f"{ATTACKERS} attackers, {kind}: places they hold", server.metric("ada_connections"), HELD, "", at_least=True
            )
            yield Row("newcomer", f"{ATTACKERS} attackers, {kind}: another's open and act", _newcomer(server.port), 1, "s")
            over.set()
            if pinged.is_alive():
                pinged.join()
            for attacker in held:
                attacker.close()


def _connect(port: int, words: bytes) -> socket.socket:
    """From an address of their own: 127.0.0.1 is who measures, and counts its places too."""
    attacker = socket.create_connection(("127.0.0.1", port), timeout=10, source_address=("127.0.0.3", 0))
    with suppress(OSError):
        attacker.sendall(words)
    attacker.setblocking(False)
    return attacker


def _answer_pings(held: list[socket.socket], over: threading.Event) -> None:
    """Says back what the server asks, so that its keepalive finds everyone alive."""
    while not over.wait(0.5):
        for attacker in held:
            with suppress(OSError):
                heard = attacker.recv(4096)
                while len(heard) >= 9:
                    length, kind, flags = int.from_bytes(heard[:3], "big"), heard[3], heard[4]
                    frame, heard = heard[9 : 9 + length], heard[9 + length :]
                    if kind == 6 and not flags & 1:
                        attacker.sendall(struct.pack(">I", 8)[1:] + b"\x06\x01\x00\x00\x00\x00" + frame)


def _newcomer(port: int) -> float:
    """Seconds until somebody from 127.0.0.2 has opened a session and acted; a minute if never."""
    begin = time.monotonic()
    try:
        opened = _post(port, "/v1/sessions", '{"model": "tiny"}')
        session = opened.split('"session_id":"')[1].split('"')[0]
        acted = _post(port, f"/v1/sessions/{session}/act", '{"step": 1, "observation": {"state": [0, 0, 0, 0]}}')
    except (OSError, IndexError):
        return 60.0
    return time.monotonic() - begin if '"step":1' in acted else 60.0


def _post(port: int, path: str, body: str) -> str:
    head = f"POST {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\nconnection: close\r\n"
    with socket.create_connection(("127.0.0.1", port), timeout=10, source_address=("127.0.0.2", 0)) as client:
        client.sendall(f"{head}content-length: {len(body)}\r\n\r\n{body}".encode())
        answer = b""
        while piece := client.recv(65536):
            answer += piece
    return answer.decode()
