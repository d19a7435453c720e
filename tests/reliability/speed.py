"""Undisturbed speed against another ada-server, whose path is in ADA_BEFORE; by turns."""

from __future__ import annotations

import os
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .process import Row, Server, load, report

TURNS, SECONDS = 12, 1.5
CLIENTS = (1, 32)


def measure() -> Iterator[Row]:
    before = os.environ.get("ADA_BEFORE")
    if not before:
        sys.exit("ADA_BEFORE must name the ada-server to compare with")
    with Server(program=Path(before)) as old, Server() as new:
        turns: dict[tuple[int, int], list[dict[str, Any]]] = {}
        for turn in range(TURNS):
            for which in (0, 1) if turn % 2 else (1, 0):
                for clients in CLIENTS:
                    words = ("--clients", clients, "--seconds", SECONDS, "--warm-up", 0.3)
                    turns.setdefault((which, clients), []).append(report(load((old, new)[which], *words)))
    for clients in CLIENTS:
        acts = [statistics.median(one["acts_per_s"] for one in turns[which, clients]) for which in (0, 1)]
        p50 = [statistics.median(one["latency_ms"]["p50"] for one in turns[which, clients]) for which in (0, 1)]
        yield Row("speed", f"{clients} clients: acts a second to before", acts[1] / acts[0], 0.98, "", at_least=True)
        yield Row("speed", f"{clients} clients: p50 to before", p50[1] / p50[0], 1.02, "")
