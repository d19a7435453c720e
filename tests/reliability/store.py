"""Sessions that outlive the process: what a commit costs, how soon a killed server is back, what an idle session takes."""

from __future__ import annotations

import json
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np

from ada_diffuser import Client

from .process import MB, RELEASE, ROOT, Row, Server, load, report

LEVELS = ("memory", "process", "power")
TURNS, SECONDS, CLIENTS = 9, 1.5, 32
#: Opened and acted in once, before the kill.
STORED = 100_000
#: Of them, those whose first act after it is timed.
COLD = 200
RESIDENT = 20_000
MILLION = 1_000_000
GIB = float(1 << 30)
#: Longest time until so many are stored.
PATIENCE_S = 1800.0


def measure() -> Iterator[Row]:
    yield from _cost("tiny")
    yield from _cost("cheetah-wind-s")
    yield from _back()
    yield _resident()


@contextmanager
def models(*names: str) -> Iterator[Path]:
    """A directory of these shipped models alone: others would be loaded and warmed up as well."""
    with tempfile.TemporaryDirectory() as directory:
        for name in names:
            shutil.copytree(ROOT / "models" / name, Path(directory) / name)
        yield Path(directory)


def _cost(model: str) -> Iterator[Row]:
    """Acts a second and their latency at each level, by turns."""
    turns: dict[str, list[dict[str, Any]]] = {level: [] for level in LEVELS}
    with ExitStack() as stack:
        directory = stack.enter_context(models(model))
        servers = {}
        for level in LEVELS:
            store = stack.enter_context(tempfile.TemporaryDirectory(dir=ROOT / "target"))
            settings = (f"models.default={model}", f"store.dir={store}", f"store.durability={level}")
            servers[level] = stack.enter_context(Server(*settings, models=directory))
        for turn in range(TURNS):
            for level in LEVELS[turn % 3 :] + LEVELS[: turn % 3]:
                words = ("--clients", CLIENTS, "--seconds", SECONDS, "--warm-up", 0.3, "--seed", turn)
                turns[level].append(report(load(servers[level], *words)))
    acts = {level: statistics.median(one["acts_per_s"] for one in turns[level]) for level in LEVELS}
    p50 = {level: statistics.median(one["latency_ms"]["p50"] for one in turns[level]) for level in LEVELS}
    yield Row(
        "store", f"{model}, {CLIENTS} sessions, process: acts a second to memory", acts["process"] / acts["memory"], 0.9, "", at_least=True
    )
    yield Row("store", "the same: p50 beyond that of memory", p50["process"] - p50["memory"], 0.3, "ms")
    yield Row("store", "the same, power: acts a second", acts["power"], 500, "", at_least=True)
    yield Row("store", "the same, power: p50 beyond that of memory", p50["power"] - p50["memory"], 10, "ms")


def _back() -> Iterator[Row]:
    with models("tiny") as directory, tempfile.TemporaryDirectory(dir=ROOT / "target") as store:
        settings = ("models.default=tiny", f"store.dir={store}", "sessions.ttl_ms=86400000")
        yield Row("store", "ready after a kill, empty store", _ready(directory, settings), 1, "s")
        state = np.zeros(4, np.float32)
        with Server(*settings, models=directory) as server, Client(server.url) as client:
            sessions = [client.open_session("tiny") for _ in range(COLD)]
            for session in sessions:
                session.act(state)
            fill(server, STORED)
            server.process.kill()
        begin = time.monotonic()
        with Server(*settings, models=directory) as server:
            ready = time.monotonic() - begin
            stored = server.metric("ada_store_sessions")
            assert stored >= STORED, stored
            yield Row("store", f"ready after a kill, {STORED:,} sessions stored", ready, 2, "s")
            # Nothing asks for a session before its act does.
            connection = HTTPConnection(server.address)
            cold, hot = [], []
            for session in sessions:
                for kind, step in ((cold, 2), (hot, 3)):
                    begin = time.monotonic()
                    _act(connection, session.session_id, step)
                    kind.append(time.monotonic() - begin)
        beyond = [(a - b) * 1e3 for a, b in zip(cold, hot, strict=True)]
        yield Row("store", "first act of a cold session beyond a hot one: median", statistics.median(beyond), 10, "ms")
        yield Row("store", "the same: the 99th of a hundred", float(np.percentile(beyond, 99)), 10, "ms")


def measure_million() -> Iterator[Row]:
    """A million sessions, each with an act."""
    with models("tiny") as directory, tempfile.TemporaryDirectory(dir=ROOT / "target") as store:
        settings = ("models.default=tiny", f"store.dir={store}", "sessions.ttl_ms=86400000", f"store.len_max={2 * MILLION}")
        state = np.zeros(4, np.float32)
        with Server(*settings, models=directory) as server, Client(server.url) as client:
            session = client.open_session("tiny")
            session.act(state)
            fill(server, MILLION)
            yield Row("million", "memory of the server with as many stored", server.memory() / MB, 1_000, "MB")
            yield Row("million", "bytes of the file for each", server.metric("ada_store_medium_bytes") / MILLION, 65_536 / 5, "B")
            server.process.kill()
        begin = time.monotonic()
        with Server(*settings, models=directory) as server:
            yield Row("million", "ready after a kill", time.monotonic() - begin, 20, "s")
            yield Row("million", "stored", server.metric("ada_store_sessions"), MILLION, "", at_least=True)
            begin = time.monotonic()
            _act(HTTPConnection(server.address), session.session_id, 2)
            yield Row("million", "first act of one of them", (time.monotonic() - begin) * 1e3, 50, "ms")


def _ready(directory: Path, settings: tuple[str, ...]) -> float:
    """Seconds from the start of the process, after another one was killed."""
    with Server(*settings, models=directory) as server:
        server.process.kill()
    begin = time.monotonic()
    with Server(*settings, models=directory):
        return time.monotonic() - begin


def _act(connection: HTTPConnection, session_id: str, step: int) -> None:
    body = json.dumps({"step": step, "observation": {"state": [0.0] * 4}})
    connection.request("POST", f"/v1/sessions/{session_id}/act", body, {"content-type": "application/json"})
    response = connection.getresponse()
    assert response.status == 200, response.read()
    response.read()


def fill(server: Server, count: int) -> None:
    """Until so many sessions are stored, each with an act; the generator is killed before it closes them."""
    words = ["--idle-sessions", str(count), "--clients", "1", "--seconds", "3600"]
    generator = subprocess.Popen([str(RELEASE / "examples" / "load"), "--url", server.url, "--json", *words], stdout=subprocess.DEVNULL)
    end = time.monotonic() + PATIENCE_S
    while server.metric("ada_store_sessions") < count:
        assert generator.poll() is None and time.monotonic() < end, "the sessions are not opened"
        time.sleep(0.5)
    generator.kill()
    generator.wait()


def _resident() -> Row:
    with models("cheetah-wind-s") as directory:
        settings = ("models.default=cheetah-wind-s", f"sessions.len_max={RESIDENT + 10}")
        with Server(*settings, models=directory) as server:
            words = ("--idle-sessions", RESIDENT, "--clients", 1, "--seconds", 0.5, "--server-pid", server.process.pid)
            memory = report(load(server, *words))["memory_mb"]
    each = (memory["idle"] - memory["before"]) * 1e6 / RESIDENT
    return Row("store", "resident sessions of cheetah-wind-s a GiB, each with an act", GIB / each, 65_000, "", at_least=True)
