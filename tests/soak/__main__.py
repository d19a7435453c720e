"""Hours of mixed work against one server: acts, forks, sessions that spill and expire, deadlines, bad requests, callers that are gone.

The memory of its process is looked at each second; what it grows by is told of the second half, when all buffers have been used once.
At the end all sessions end, and the counters have to add up. The last line is `growth_mb=X growth_percent_per_hour=Y`.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from tests.reliability.process import MB, RELEASE, ROOT, Row, Server

from .life import Life
from .trend import slope

#: What may be wrong with a server, to see that it would be found.
CONTROLS = {"leak": ("--fault", "told=leak:64")}
SETTINGS = (
    "sessions.len_max=150",
    "sessions.evict_idle_ms=50",
    "sessions.unused_idle_ms=50",
    "sessions.ttl_ms=5000",
    "record.dir_bytes_max=67108864",
    "record.file_bytes_max=8388608",
)
GROWTH_MB, GROWTH_PERCENT = 16.0, 1.0
#: In less than this a percent an hour is less than what allocators do by chance.
PERCENT_FROM_S = 1800.0
SETTLES_S = 30.0


@dataclass(frozen=True)
class Sample:
    """A look at the server."""

    second: float
    memory: float
    sessions: float


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=120.0, help="how long (default %(default)g)")
    parser.add_argument("--seed", type=int, default=0, help="of what clients do (default %(default)s)")
    parser.add_argument("--control", choices=CONTROLS, help="a server with a fault, which has to be found: the status is then 1")
    parser.add_argument("--json", type=Path, metavar="FILE", help="writes rows, and memory by the minute, to FILE")
    flags = parser.parse_args(words)
    if not (RELEASE / "ada-server").exists():
        parser.error(f"no server in {RELEASE}: build it with `make build`")
    with tempfile.TemporaryDirectory(dir=ROOT / "target") as place:
        settings = (*SETTINGS, f"store.dir={place}/store", f"record.dir={place}/record")
        with Server(*settings, flags=CONTROLS.get(flags.control, ())) as server:
            life = Life(server.address, flags.seed)
            life.start()
            samples = _watch(server, life, flags.minutes * 60)
            life.stop()
            rows = [*_growth(samples), *_sums(server, life)]
    for row in rows:
        print(row)
    for surprise in life.surprises[:10]:
        print(f"surprise: {surprise}", file=sys.stderr)
    print(", ".join(f"{count} {what}" for what, count in sorted(life.done.items())), file=sys.stderr)
    growth_mb, percent = rows[0].measured, rows[1].measured
    if flags.json:
        _write(flags.json, rows, samples, life)
    print(f"growth_mb={growth_mb:.2f} growth_percent_per_hour={percent:.2f}")
    return 0 if all(row.passes for row in rows) else 1


def _watch(server: Server, life: Life, seconds: float) -> list[Sample]:
    """A sample each second until the time is up."""
    samples: list[Sample] = []
    begin = said = time.monotonic()
    while (now := time.monotonic()) < begin + seconds and server.process.poll() is None:
        samples.append(Sample(now - begin, server.memory(), server.metric("ada_sessions")))
        if now - said >= 60:
            said = now
            acts, left = life.done["acts"], (begin + seconds - now) / 60
            print(f"{samples[-1].memory / MB:.1f} MB, {acts} acts, {len(life.surprises)} surprises, {left:.0f} min left", file=sys.stderr)
        time.sleep(max(0.0, now + 1.0 - time.monotonic()))
    if server.process.poll() is not None:
        sys.exit(f"the server has ended with {server.process.returncode}")
    return samples


def _growth(samples: Sequence[Sample]) -> Iterator[Row]:
    half = samples[len(samples) // 2 :]
    seconds = half[-1].second - half[0].second
    rate = slope([(sample.second, sample.memory) for sample in half])
    percent = rate * 3600 / median(sample.memory for sample in half) * 100
    yield Row("soak", f"memory: growth in the last {seconds / 60:.1f} minutes", rate * seconds / MB, GROWTH_MB, "MB")
    yield Row("soak", "memory: growth", percent, GROWTH_PERCENT if seconds >= PERCENT_FROM_S else float("inf"), "%/h")


def _sums(server: Server, life: Life) -> Iterator[Row]:
    """What has to add up when nobody is there any more."""
    end = time.monotonic() + SETTLES_S
    with suppress(TimeoutError):
        while any(server.metric(name) for name in ("ada_inflight_acts", "ada_queue_depth", "ada_store_sessions", "ada_sessions")):
            if time.monotonic() > end:
                raise TimeoutError
            time.sleep(0.25)
    ended = server.metric("ada_sessions_ended_total")
    received, told = server.metric("ada_acts_received_total"), server.metric("ada_acts_total")
    left = server.metric("ada_store_sessions")
    yield Row("soak", "sessions: opened, not ended, and not there", abs(server.metric("ada_sessions_created_total") - ended - left), 0, "")
    yield Row("soak", "sessions that are left when all have ended", left + server.metric("ada_sessions"), 0, "")
    yield Row("soak", "acts: received, and neither answered, shed, cancelled nor failed", abs(received - told), 0, "")
    yield Row("soak", "acts in work or waiting", server.metric("ada_inflight_acts") + server.metric("ada_queue_depth"), 0, "")
    yield Row("soak", "panics", server.metric("ada_engine_panics_total"), 0, "")
    yield Row("soak", "answers that nobody had asked for", len(life.surprises), 0, "")
    yield Row("soak", "acts", received, 1, "", at_least=True)
    yield Row("soak", "sessions that came back from the store", server.metric("ada_sessions_revived_total"), 1, "", at_least=True)


def _write(path: Path, rows: Sequence[Row], samples: Sequence[Sample], life: Life) -> None:
    minutes = [
        {"minute": i, "memory_mb": round(sample.memory / MB, 2), "sessions": sample.sessions} for i, sample in enumerate(samples[::60])
    ]
    told: dict[str, Any] = {
        "machine": platform.machine(),
        "rows": [row.as_json() for row in rows],
        "done": dict(life.done),
        "memory": minutes,
    }
    path.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
