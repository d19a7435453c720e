"""Twice the load that the engine bears: who is answered, and in time?

Starts ada-server with one worker on one core, puts the load of examples/load on it from another, and compares what is answered with the
capacity of the same run (48 sessions in a closed loop, cold plans). See docs/reliability.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
RELEASE = ROOT / "target" / "release"
START_S = 60.0
Report = dict[str, Any]
Row = dict[str, Any]


class Server:
    """ada-server on one core, and the load generator on another."""

    def __init__(self, seconds: float, *settings: str) -> None:
        self.seconds = seconds
        words = ["--models", str(ROOT / "models"), "--listen", "127.0.0.1:0", "--set", "telemetry.format=json"]
        for setting in ("engine.workers=1", "server.io_threads=1", *settings):
            words += ["--set", setting]
        command = [*_on_core(0), str(RELEASE / "ada-server"), *words]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        line = next(line for line in self.process.stderr if '"listening"' in line)
        self.url = f"http://{json.loads(line)['address']}"
        # Nobody reads on: a log that is not read costs its lines and nothing else.
        end = time.monotonic() + START_S
        while not self._is_ready():
            if time.monotonic() > end:
                raise SystemExit("the server does not get ready")
            time.sleep(0.1)

    def _is_ready(self) -> bool:
        with suppress(OSError):
            return urllib.request.urlopen(f"{self.url}/readyz", timeout=1).status == 200
        return False

    def load(self, clients: int, *words: object, seconds: float | None = None) -> Callable[[], Report]:
        """Starts the generator; its report, once it is asked for."""
        fixed = ["--url", self.url, "--json", "--set", "streaming=false", "--seconds", str(seconds or self.seconds)]
        command = [*_on_core(1), str(RELEASE / "examples" / "load"), *fixed, "--clients", str(clients), *map(str, words)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        return lambda: json.loads(process.communicate()[0])

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait()


def _on_core(core: int) -> list[str]:
    return ["taskset", "-c", str(core)] if (os.cpu_count() or 1) > core else []


def _row(case: str, capacity: float, report: Report, **judged: Any) -> Row:
    latency = report["latency_ms"]
    return {
        "case": case,
        "capacity_acts_per_s": round(capacity),
        "goodput": round(report["acts_per_s"] / capacity, 2),
        "p50_ms": round(latency["p50"], 1),
        "p99_ms": round(latency["p99"], 1),
        "evaluations_per_act": round(report["evaluations_per_act"], 1),
        "errors": report["errors"],
        **judged,
    }


def _bounded(value: float, bound: float, at_least: bool) -> Row:
    return {"ratio": round(value, 2), "bound": bound, "passes": value >= bound if at_least else value <= bound}


def measure(seconds: float, tell: Callable[[Row], None]) -> None:
    """All cases, one after the other."""

    def goodput(case: str, capacity: float, report: Report) -> None:
        tell(_row(case, capacity, report, **_bounded(report["acts_per_s"] / capacity, 0.8, at_least=True)))

    for anytime in ("true", "false"):
        server = Server(seconds, f"engine.anytime={anytime}")
        try:
            capacity = server.load(48)()["acts_per_s"]
            hasty = ("--arrivals", "poisson", "--connections", 48, "--rate", 2 * capacity)
            goodput(f"deadlines of 50 ms, anytime = {anytime}", capacity, server.load(1500, *hasty, "--deadline-ms", 50)())
            if anytime == "false":
                continue
            goodput("clients that give up after 500 ms", capacity, server.load(2000, *hasty, "--give-up-ms", 500)())
            _patient(server, capacity, tell)
            _greedy(server, capacity, tell)
        finally:
            server.stop()


def _patient(server: Server, capacity: float, tell: Callable[[Row], None]) -> None:
    words = ("--arrivals", "poisson", "--rate")
    alone = server.load(64, *words, 0.8 * capacity)()
    tell(_row("the patient alone at .8 of capacity", capacity, alone))
    crowd = server.load(1500, *words, 2 * capacity - 20, "--connections", 48, "--deadline-ms", 100, seconds=server.seconds + 5)
    time.sleep(3)
    beside = server.load(20, *words, 20)()
    crowd()
    ratio = beside["latency_ms"]["p99"] / alone["latency_ms"]["p99"]
    tell(_row("the patient beside hasty ones, p99 to alone", capacity, beside, **_bounded(ratio, 3.0, at_least=False)))


def _greedy(server: Server, capacity: float, tell: Callable[[Row], None]) -> None:
    words = ("--arrivals", "poisson", "--connections", 8, "--rate", 0.3 * capacity)
    alone = server.load(8, *words)()
    tell(_row("eight clients alone at .3 of capacity", capacity, alone))
    greedy = server.load(128, "--connections", 1, seconds=server.seconds + 3)
    time.sleep(2)
    beside = server.load(8, *words)()
    tell(_row("the greedy one with 128 acts at once", capacity, greedy()))
    ratio = beside["latency_ms"]["p50"] / alone["latency_ms"]["p50"]
    tell(_row("the eight beside it, p50 to alone", capacity, beside, **_bounded(ratio, 3.0, at_least=False)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0, help="of each measurement (default: 8)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write the rows too")
    flags = parser.parse_args()
    rows: list[Row] = []

    def tell(row: Row) -> None:
        verdict = {True: "pass", False: "MISS"}.get(row.get("passes", None), "")
        ratio = f"{row['ratio']:6.2f} (bound {row['bound']})" if "ratio" in row else ""
        print(
            f"{row['case']:46s} goodput {row['goodput']:4.2f}  p50 {row['p50_ms']:7.1f}  p99 {row['p99_ms']:7.1f} ms {ratio} {verdict}",
            flush=True,
        )
        rows.append(row)

    measure(flags.seconds, tell)
    if flags.json:
        flags.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0 if all(row.get("passes", True) for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
