"""A log that cannot be written, in the middle of load."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from .process import Row, Server, load, report

SECONDS = 60
#: Every act is a line, so that there is much to write.
SETTINGS = ("engine.workers=2", "telemetry.log=debug", "telemetry.log_repeats_max=0", "server.drain_timeout_ms=2000")


def measure() -> Iterator[Row]:
    with _pipe() as (read, write):
        yield from _under_load("its reader is gone", write, lambda: read.close())
    with _pipe() as (_read, write):
        yield from _under_load("nobody reads it", write, lambda: None)
    with _small_disk() as log:
        yield from _under_load("its disk is full", log, lambda: None)


def _under_load(case: str, log: IO[str], breaks: object) -> Iterator[Row]:
    with Server(*SETTINGS, log=log) as server:
        generator = load(server, "--model", "tiny", "--clients", 16, "--seconds", SECONDS)
        time.sleep(2)
        assert callable(breaks)
        breaks()
        acts = report(generator)
        yield Row("log", f"{case}, a minute: acts that failed of {acts['acts']}", sum(acts["errors"].values()), 0, "acts")
        yield Row("log", f"{case}: workers that live", server.workers(), 2, "", at_least=True)
        yield Row("log", f"{case}: ready", float(server.is_ready()), 1, "", at_least=True)
        missing = server.metric("ada_log_lines_left_out_total")
        yield Row("log", f"{case}: lines counted as missing", missing, 1, "lines", at_least=True)
        status, took = server.stop()
        yield Row("log", f"{case}: exit status", status, 0, "")
        yield Row("log", f"{case}: drain", took, 3, "s")


@contextmanager
def _pipe() -> Iterator[tuple[IO[str], IO[str]]]:
    read, write = os.pipe()
    with os.fdopen(read) as reader, os.fdopen(write, "w") as writer:
        yield reader, writer


@contextmanager
def _small_disk() -> Iterator[IO[str]]:
    """A file on a disk of 64 KiB, which needs the right to mount one."""
    with tempfile.TemporaryDirectory() as place:
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "none", place], check=True)
        try:
            with (Path(place) / "log").open("w") as log:
                yield log
        finally:
            subprocess.run(["umount", "-l", place], check=True)
