"""Twice the load that the engine bears: who is answered, and in time?

One worker on one core, examples/load on another; what is answered is compared with the capacity of the same run: 48 sessions in a closed
loop, cold plans.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from typing import Any

from .process import Row, Server, load, report

SECONDS = 6.0
POISSON = ("--arrivals", "poisson")


def measure() -> Iterator[Row]:
    for anytime in ("true", "false"):
        with Server("engine.workers=1", "server.io_threads=1", f"engine.anytime={anytime}", cores=[0]) as server:
            capacity = report(_start(server, 48))["acts_per_s"]
            hasty = (*POISSON, "--connections", 48, "--rate", 2 * capacity)
            answered = report(_start(server, 1500, *hasty, "--deadline-ms", 50))
            yield _goodput(f"deadlines of 50 ms, anytime = {anytime}", answered, capacity)
            if anytime == "true":
                answered = report(_start(server, 2000, *hasty, "--give-up-ms", 500))
                yield _goodput("clients that give up after 500 ms", answered, capacity)
                yield _patient(server, capacity)
                yield _greedy(server, capacity)


def _goodput(case: str, answered: dict[str, Any], capacity: float) -> Row:
    return Row("overload", f"{case}: goodput to capacity", answered["acts_per_s"] / capacity, 0.8, "", at_least=True)


def _patient(server: Server, capacity: float) -> Row:
    alone = report(_start(server, 64, *POISSON, "--rate", 0.8 * capacity))
    rate = ("--rate", 2 * capacity - 20, "--connections", 48, "--deadline-ms", 100)
    hasty = _start(server, 1500, *POISSON, *rate, seconds=SECONDS + 5)
    time.sleep(3)
    beside = report(_start(server, 20, *POISSON, "--rate", 20))
    hasty.wait()
    ratio = beside["latency_ms"]["p99"] / alone["latency_ms"]["p99"]
    return Row("overload", "a patient client beside hasty ones: p99 to alone at .8", ratio, 3, "")


def _greedy(server: Server, capacity: float) -> Row:
    words = (*POISSON, "--connections", 8, "--rate", 0.3 * capacity)
    alone = report(_start(server, 8, *words))
    greedy = _start(server, 128, "--connections", 1, seconds=SECONDS + 3)
    time.sleep(2)
    beside = report(_start(server, 8, *words))
    greedy.wait()
    ratio = beside["latency_ms"]["p50"] / alone["latency_ms"]["p50"]
    return Row("overload", "eight clients beside one with 128 acts at once: p50 to alone", ratio, 3, "")


def _start(server: Server, clients: int, *words: object, seconds: float = SECONDS) -> subprocess.Popen[str]:
    return load(server, "--set", "streaming=false", "--clients", clients, "--seconds", seconds, *words, cores=[1])
