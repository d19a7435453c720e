"""A server process that is measured, and what is judged about it."""

from __future__ import annotations

import json
import os
import re
import resource
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).parents[2]
RELEASE = ROOT / "target" / "release"
START_S = 60.0
MB = 1e6
#: Settings of every server, to see a check fail (`--set`).
EXTRA: list[str] = []


@dataclass(frozen=True)
class Row:
    """A figure and its bound."""

    scenario: str
    case: str
    measured: float
    bound: float
    unit: str
    #: Whether the bound is the least that is wanted, rather than the most that is allowed.
    at_least: bool = False

    @property
    def passes(self) -> bool:
        return self.measured >= self.bound if self.at_least else self.measured <= self.bound

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "measured": round(self.measured, 4), "passes": self.passes}

    def __str__(self) -> str:
        sign, verdict = ">=" if self.at_least else "<=", "pass" if self.passes else "MISS"
        return f"{self.scenario:9s} {self.case:58s} {self.measured:10.2f} {sign} {self.bound:8.2f} {self.unit:6s} {verdict}"


class Server:
    """ada-server over a directory of models, on a port of its own."""

    def __init__(
        self,
        *settings: str,
        models: Path = ROOT / "models",
        log: int | IO[str] = subprocess.DEVNULL,
        cores: Iterable[int] = (),
        program: Path = RELEASE / "ada-server",
        flags: Sequence[str] = (),
    ) -> None:
        address = f"127.0.0.1:{_free_port()}"
        command = [*on_cores(cores), str(program), "--models", str(models), "--listen", address, *flags]
        for setting in ("telemetry.format=json", *settings, *EXTRA):
            command += ["--set", setting]
        open_files_max()
        self.process = subprocess.Popen(command, stderr=log, text=True)
        self.address, self.url = address, f"http://{address}"
        end = time.monotonic() + START_S
        while not self.is_ready():
            if time.monotonic() > end or self.process.poll() is not None:
                sys.exit("the server does not get ready")
            time.sleep(0.05)

    @property
    def port(self) -> int:
        return int(self.address.rsplit(":", 1)[1])

    def is_ready(self) -> bool:
        with suppress(OSError):
            return bool(urllib.request.urlopen(f"{self.url}/readyz", timeout=1).status == 200)
        return False

    def metric(self, name: str) -> float:
        """Value of a metric, all labels together."""
        text = urllib.request.urlopen(f"{self.url}/metrics", timeout=10).read().decode()
        return sum(float(value) for value in re.findall(rf"^{name}(?:{{[^}}]*}})? (\S+)$", text, re.M))

    def models(self) -> set[str]:
        """Names of the models that it serves."""
        answer = json.load(urllib.request.urlopen(f"{self.url}/v1/models", timeout=10))
        return {model["name"] for model in answer["models"]}

    def memory(self, which: str = "VmRSS") -> float:
        """Bytes."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        found = re.search(rf"^{which}:\s+(\d+) kB", status, re.M)
        assert found, f"no {which}"
        return int(found[1]) * 1024.0

    def processor_s(self) -> float:
        """Seconds of processor time so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def workers(self) -> int:
        """Threads of the engine."""
        names = [path.read_text() for path in Path(f"/proc/{self.process.pid}/task").glob("*/comm")]
        return sum(name.startswith("ada-engine-") for name in names)

    def stop(self) -> tuple[int, float]:
        """Tells it to end: exit status, and how long that took."""
        begin = time.monotonic()
        self.process.terminate()
        return self.process.wait(30), time.monotonic() - begin

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()


def refused_by(event: dict[str, Any]) -> str | None:
    """The checkpoint that this line of the log says is refused."""
    return str(event["model"]) if event.get("level") == "ERROR" and event.get("message") == "checkpoint refused" else None


def load(server: Server, *words: object, cores: Iterable[int] = ()) -> subprocess.Popen[str]:
    """Starts the generator of examples/load against a server; :func:`report` has its report."""
    program = [*on_cores(cores), str(RELEASE / "examples" / "load")]
    return subprocess.Popen([*program, "--url", server.url, "--json", *map(str, words)], stdout=subprocess.PIPE, text=True)


def report(generator: subprocess.Popen[str]) -> dict[str, Any]:
    return dict(json.loads(generator.communicate()[0]))


def on_cores(cores: Iterable[int]) -> list[str]:
    """The words before a command that is to run on these cores alone; none: on all."""
    there = [str(core) for core in cores if core < (os.cpu_count() or 1)]
    return ["taskset", "-c", ",".join(there)] if there else []


def open_files_max() -> None:
    """As many open files as the system lets us have; a server that is started inherits it."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])
