"""The real server as a process, for the tests that need one."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ada_diffuser import Client, Unavailable

ROOT = Path(__file__).resolve().parents[2]
BINARY = Path(os.environ.get("ADA_SERVER", ROOT / "target/release/ada-server"))


@contextmanager
def running(log: Path, *flags: str, kill: bool = False) -> Iterator[str]:
    """`host:port` of a server over `models/`; at the end it is told to stop and must obey, or is killed with SIGKILL."""
    assert BINARY.exists(), f"no server at {BINARY}: build it with `make build`"
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    with log.open("wb") as sink:
        server = subprocess.Popen([str(BINARY), "--listen", address, *flags], cwd=ROOT, stdout=sink, stderr=sink)
    try:
        with Client(f"http://{address}") as client:
            ready = any(_is_ready(client) for _ in range(60) if server.poll() is None)
        assert ready, f"the server ended, or is not ready after a minute:\n{log.read_text()}"
        yield address
        server.send_signal(signal.SIGKILL if kill else signal.SIGTERM)
        assert server.wait(30) == (-signal.SIGKILL if kill else 0), log.read_text()
    finally:
        server.kill()
        server.wait()


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
