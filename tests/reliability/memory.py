"""Memory that the caps see, and what a refusal costs."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator

import numpy as np

from ada_diffuser import AdaError, Client, Executed, RetryPolicy

from .process import MB, Row, Server

SESSIONS = 150
#: `limits.executed_len_max`.
STEPS = 4096
CALLS = 2000
ROUNDS = 4
FULL = 2000


def measure() -> Iterator[Row]:
    with Server("models.default=tiny") as server, Client(server.url) as client:
        yield from _memory(server, client)
    with Server("models.default=tiny", f"sessions.len_max={FULL}", "sessions.evict_idle_ms=600000") as server:
        yield _refusal(server)


def _memory(server: Server, client: Client) -> Iterator[Row]:
    state, action = np.zeros(4, np.float32), np.zeros(2, np.float32)
    past = [Executed(state=state, action=action, reward=0.5)] * STEPS
    # The first ones of all are not counted: code and buffers are the same for one session and for many.
    with client.open_session("tiny") as first:
        first.act(state, executed=past)
    before, counted = server.memory(), server.metric("ada_session_state_bytes")
    sessions = [client.open_session("tiny") for _ in range(SESSIONS)]
    for session in sessions:
        session.act(state, executed=past)
    counted = server.metric("ada_session_state_bytes") - counted
    yield Row(
        "memory",
        f"{SESSIONS} sessions told {STEPS} steps: beyond 1.2 times the counted",
        (server.memory() - before - 1.2 * counted) / MB,
        16,
        "MB",
    )
    for session in sessions:
        session.close()
    yield Row("memory", "the same after they are closed", (server.memory() - before) / MB, 16, "MB")


def _refusal(server: Server) -> Row:
    with Client(server.url, retry=RetryPolicy(attempts=1)) as client:
        used = [client.open_session("tiny") for _ in range(FULL)]
        for session in used:
            # Those that nobody has asked for would give their place.
            session.summary()
        opened, asked = [], []
        for _ in range(ROUNDS):
            asked.append(_cost(server, lambda: client.summary("00000000-0000-4000-8000-000000000000")))
            opened.append(_cost(server, lambda: client.open_session("tiny")))
    return Row(
        "refusal",
        "of an open, beyond that of a get: the server's time",
        (statistics.median(opened) - statistics.median(asked)) * 1e6,
        50,
        "us",
    )


def _cost(server: Server, call: Callable[[], object]) -> float:
    """Seconds of the server's processor for one call, which is refused."""
    begin = server.processor_s()
    for _ in range(CALLS):
        try:
            call()
        except AdaError:
            continue
        raise AssertionError("it was to be refused")
    return (server.processor_s() - begin) / CALLS
