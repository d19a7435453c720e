"""Ten thousand acts, recorded and replayed on other threads and batches; and what recording costs, by turns."""

from __future__ import annotations

import json
import statistics
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from .process import RELEASE, ROOT, Row, Server, load, report

ACTS = 10_000
#: What is recorded, in turn: streaming, plans anew by every chunk, all noise there is, and deadlines that degrade.
LOADS = (
    ("--model", "cheetah-wind-s", "--clients", 16, "--set", "eta=0.7", "--set", "latent=sample"),
    ("--model", "cheetah-wind-s", "--clients", 8, "--face", "batch", "--set", "streaming=false"),
    ("--model", "cheetah-wind-s", "--clients", 8, "--set", "streaming=false", "--deadline-ms", 12),
    ("--model", "tiny", "--clients", 16, "--set", "temperature=1", "--set", "action_horizon=2", "--set", "picard_window=3"),
)
#: (workers, rows of an evaluation) of the replays; the server has two workers and 32 rows.
REPLAYS = ((1, 1), (2, 32), (3, 7))
TURNS, SECONDS = 12, 1.5
#: A model of use, and the smallest there is, to whose acts a recording adds most.
COSTS = (("cheetah-wind-s", 1), ("cheetah-wind-s", 32), ("tiny", 1), ("tiny", 32))


def measure() -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as folder:
        yield from _replayed(Path(folder))
    with tempfile.TemporaryDirectory() as folder:
        yield from _cost(Path(folder))


def _replayed(folder: Path) -> Iterator[Row]:
    with Server(f"record.dir={folder}", "engine.workers=2") as server:
        turn = 0
        while turn % len(LOADS) or server.metric("ada_record_entries_total") < ACTS:
            report(load(server, *LOADS[turn % len(LOADS)], "--seconds", 1, "--warm-up", 0.1, "--seed", turn))
            turn += 1
        yield Row("recording", "entries that were left out", server.metric("ada_record_dropped_total"), 0, "acts")
        server.stop()
    files = sorted(folder.glob("*.adar"))
    for workers, batch in REPLAYS:
        words = ["--workers", str(workers), "--batch", str(batch), "--json", "--models", str(ROOT / "models")]
        done = subprocess.run(
            [str(RELEASE / "ada-server"), "replay", *words, *map(str, files)], capture_output=True, text=True, check=False
        )
        found: dict[str, Any] = json.loads(done.stdout)
        case = f"{workers} workers, {batch} rows: acts that are not equal of {found['acts']}"
        yield Row("recording", case, found["acts"] - found["equal"] + abs(done.returncode), 0, "acts")
        yield Row("recording", f"{workers} workers, {batch} rows: acts replayed", found["acts"], ACTS, "acts", at_least=True)
        degraded = sum(file["degraded"] for file in found["files"])
        yield Row("recording", f"{workers} workers, {batch} rows: of them degraded by a deadline", degraded, 1, "acts", at_least=True)
        yield Row("recording", f"{workers} workers, {batch} rows: acts a second", found["acts"] / found["seconds"], 0, "1/s", at_least=True)


def _cost(folder: Path) -> Iterator[Row]:
    with Server() as plain, Server(f"record.dir={folder}") as recording:
        turns: dict[tuple[int, int], list[dict[str, Any]]] = {}
        for turn in range(TURNS):
            for which in (0, 1) if turn % 2 else (1, 0):
                for at, (model, clients) in enumerate(COSTS):
                    words = ("--model", model, "--clients", clients, "--seconds", SECONDS, "--warm-up", 0.3)
                    turns.setdefault((which, at), []).append(_turn((plain, recording)[which], words))
        written = recording.metric("ada_record_bytes_total") / recording.metric("ada_record_entries_total")
        left_out = recording.metric("ada_record_dropped_total")
        entries = recording.metric("ada_record_entries_total")
    for at, (model, clients) in enumerate(COSTS):
        # Turn by turn: what else the machine does comes and goes.
        pairs = list(zip(turns[0, at], turns[1, at], strict=True))
        ratio = statistics.median(with_["acts_per_s"] / without["acts_per_s"] for without, with_ in pairs)
        beyond = statistics.median(with_["latency_ms"]["p50"] - without["latency_ms"]["p50"] for without, with_ in pairs)
        processor = statistics.median(with_["processor_us"] / without["processor_us"] for without, with_ in pairs)
        acts = statistics.median(without["acts_per_s"] for without, _ in pairs)
        yield Row("recording", f"{model}, {clients} clients: acts a second without", acts, 0, "1/s", at_least=True)
        yield Row("recording", f"{model}, {clients} clients: acts a second to without", ratio, 0.9, "", at_least=True)
        yield Row("recording", f"{model}, {clients} clients: p50 beyond without", beyond, 0.3, "ms")
        yield Row("recording", f"{model}, {clients} clients: processor time of an act to without", processor, 1.1, "")
    yield Row("recording", "bytes of an act", written, 4096, "B")
    yield Row("recording", f"left out of {left_out + entries:.0f} under full load", left_out, 0, "acts")


def _turn(server: Server, words: tuple[object, ...]) -> dict[str, Any]:
    """What the generator says, and what an act took of the server's processor time, which does not depend on what else runs."""
    processor, acts = server.processor_s(), server.metric("ada_acts_total")
    told = report(load(server, *words))
    took = server.processor_s() - processor
    return {**told, "processor_us": 1e6 * took / (server.metric("ada_acts_total") - acts)}
