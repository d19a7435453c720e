"""Programs as processes: run to the end for their JSON lines, or kept running while they are measured."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from socket import create_connection, create_server
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PEERS = Path(__file__).resolve().parent
RELEASE = ROOT / "target/release"
SERVER = RELEASE / "ada-server"
LOAD = RELEASE / "examples/load"
MAKE_RANDOM = RELEASE / "examples/make_random"
TIME_DENOISERS = RELEASE / "examples/time_denoisers"
TIME_ACTS = RELEASE / "examples/time_acts"

# One program never takes longer than this, in seconds.
PATIENCE = 900.0


class NotMeasured(Exception):
    """A program is missing, failed, or did not answer."""


def run(*command: object) -> list[dict[str, Any]]:
    """The JSON lines that a program prints."""
    words = [str(word) for word in command]
    if not Path(words[0]).exists():
        raise NotMeasured(f"{_short(words[0])} is not there")
    try:
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        raise NotMeasured(f"{_short(words[0])} took longer than {PATIENCE:.0f} s") from None
    if done.returncode != 0:
        raise NotMeasured(f"`{' '.join([_short(words[0]), *words[1:]])}` failed: {_complaint(done.stderr)}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def peer(script: str, *arguments: object) -> list[dict[str, Any]]:
    """The JSON lines of one of the PyTorch scripts."""
    return run(sys.executable, PEERS / script, *arguments)


def free_port() -> int:
    """A port that nobody listens on now."""
    with create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


@contextmanager
def _running(words: Sequence[str], ready: str) -> Iterator[subprocess.Popen[bytes]]:
    """The program while it is needed, from the moment that `ready` (an address, or `http://...`) answers."""
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(words, cwd=ROOT, stdout=log, stderr=log)
        try:
            deadline = time.monotonic() + 120
            while not _answers(ready):
                if process.poll() is not None or time.monotonic() > deadline:
                    log.seek(0)
                    raise NotMeasured(f"{_short(words[0])} did not become ready: {_complaint(log.read().decode(errors='replace'))}")
                time.sleep(0.05)
            yield process
        finally:
            process.terminate()
            try:
                process.wait(15)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _answers(ready: str) -> bool:
    try:
        if ready.startswith("http"):
            with urllib.request.urlopen(ready, timeout=1):
                return True
        host, port = ready.split(":")
        with create_connection((host, int(port)), timeout=1):
            return True
    except OSError:
        return False


class Ours:
    """A running ada-server, to be put under load."""

    def __init__(self, port: int, pid: int) -> None:
        self.url, self.pid = f"http://127.0.0.1:{port}", pid

    def load(self, *flags: object) -> dict[str, Any]:
        """What the load generator reports; failed acts are a failure."""
        report = run(LOAD, "--url", self.url, "--json", *flags)[0]
        if report["errors"]:
            raise NotMeasured(f"acts failed: {report['errors']}")
        return report


@contextmanager
def ada_server(models: Path, default: str = "narrow") -> Iterator[Ours]:
    """A fresh server over these models, with room for many sessions."""
    if not SERVER.exists():
        raise NotMeasured(f"{_short(str(SERVER))} is not there")
    port = free_port()
    settings = ["sessions.len_max=20000", "telemetry.log=warn"]
    words = [str(SERVER), "--listen", f"127.0.0.1:{port}", "--models", str(models), "--default-model", default]
    for setting in settings:
        words += ["--set", setting]
    with _running(words, f"http://127.0.0.1:{port}/readyz") as process:
        yield Ours(port, process.pid)


class Theirs:
    """A running Python policy server, to be put under load."""

    def __init__(self, port: int) -> None:
        self.port = port

    def load(self, *flags: object) -> dict[str, Any]:
        """What its load generator reports."""
        return peer("python_policy_server.py", "load", "--port", self.port, *flags)[0]


@contextmanager
def python_server(evaluations: int) -> Iterator[Theirs]:
    """A fresh Python policy server that spends this many network evaluations on an act."""
    port = free_port()
    words = [sys.executable, str(PEERS / "python_policy_server.py"), "serve", "--port", str(port), "--evaluations", str(evaluations)]
    with _running(words, f"127.0.0.1:{port}"):
        yield Theirs(port)


def _short(path: str) -> str:
    return str(Path(path).relative_to(ROOT)) if Path(path).is_relative_to(ROOT) else Path(path).name


def _complaint(text: str) -> str:
    """What a program said last, or the line that it calls an error."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    named = [line for line in lines if line.lower().startswith("error")]
    return (named or lines[-1:] or ["no word"])[0]
