"""The real server as a process, for the tests that need one."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ada_diffuser import Client, Unavailable

ROOT = Path(__file__).resolve().parents[2]
BINARY = Path(os.environ.get("ADA_SERVER", ROOT / "target/release/ada-server"))


class Server:
    """The real server as a process, that may be killed and started again at its address."""

    def __init__(self, log: Path, *flags: str) -> None:
        assert BINARY.exists(), f"no server at {BINARY}: build it with `make build`"
        self.port = _free_port()
        self.address = f"127.0.0.1:{self.port}"
        self._log, self._flags = log, flags
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Does not wait until it is there."""
        with self._log.open("ab") as sink:
            self._process = subprocess.Popen([str(BINARY), "--listen", self.address, *self._flags], cwd=ROOT, stdout=sink, stderr=sink)

    def wait_ready(self) -> None:
        with Client(f"http://{self.address}") as client:
            ready = any(_is_ready(client) for _ in range(60) if self._process and self._process.poll() is None)
        assert ready, f"the server ended, or is not ready after a minute:\n{self.said()}"

    def freeze(self) -> None:
        """It does nothing any more, though its connections stand; a signal that is sent has not stopped every thread yet."""
        assert self._process
        self._process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, self._process.pid, os.WSTOPPED)

    def kill(self) -> None:
        """SIGKILL: it has no time to say or write anything."""
        if self._process:
            self._process.kill()
            self._process.wait()

    def end(self) -> None:
        """It is told to stop, and must obey."""
        assert self._process
        self._process.send_signal(signal.SIGTERM)
        assert self._process.wait(30) == 0, self.said()

    def said(self) -> str:
        return self._log.read_text(errors="replace")

    def unread(self) -> int:
        """Connections with bytes that the server has not read yet."""
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        # local address, state 01 (established), bytes to be sent and to be read
        return sum(row[1].endswith(f":{self.port:04X}") and row[3] == "01" and row[4].split(":")[1].strip("0") != "" for row in rows)


def _free_port() -> int:
    """Below those that are given out for outgoing connections: nobody gets it while a server that was killed is away."""
    while True:
        port = random.randrange(20_000, 32_000)
        with suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port


@contextmanager
def running(log: Path, *flags: str, kill: bool = False) -> Iterator[str]:
    """`host:port` of a server over `models/`; at the end it is told to stop and must obey, or is killed with SIGKILL."""
    server = Server(log, *flags)
    try:
        server.start()
        server.wait_ready()
        yield server.address
        if not kill:
            server.end()
    finally:
        server.kill()


def gone(pid: int, within_s: float = 10.0) -> None:
    """Fails if the process is still there after a while; a dead one that nobody has waited for is none."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return
        if state == "Z":
            return
        time.sleep(0.05)
    raise AssertionError(f"process {pid} is still there")


def descendants(pid: int) -> list[int]:
    """Processes: children, their children and so on."""
    parents: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(int(stat.parent.name))
        except (FileNotFoundError, ProcessLookupError):
            continue
    found, new = list[int](), [pid]
    while new:
        new = [child for one in new for child in parents.get(one, [])]
        found += new
    return found


def _is_ready(client: Client) -> bool:
    try:
        client.wait_ready(1)
    except Unavailable:
        return False
    return True
