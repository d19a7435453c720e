"""`ada-trainer` and `ada-server`, for commands that run them: where they are, and a server of one's own on loopback."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from ada_diffuser import leash
from ada_diffuser.client import Client
from ada_diffuser.errors import Unavailable

#: Where `make build` leaves the programs.
BUILT = Path("target/release")
READY_S = 60.0
STOP_S = 30.0


@dataclass(frozen=True)
class Programs:
    """`ada-trainer` and `ada-server`."""

    trainer: str
    server: str

    @classmethod
    def find(cls, folder: Path | None) -> Programs:
        """In `folder`, else on the PATH, else in `target/release`. ValueError where one is nowhere."""
        return cls(*(_find(name, folder) for name in ("ada-trainer", "ada-server")))

    @staticmethod
    def exported(recording: Path, folder: Path | None) -> str:
        """A recording of ada-server as JSON lines. ValueError where there is no such program, or it cannot read it."""
        try:
            server = _find("ada-server", folder)
        except ValueError as error:
            line = f"ada-server replay --export {recording} > {recording.with_suffix('.jsonl')}"
            raise ValueError(f"{recording}: {error}; or replay what `{line}` writes, from wherever that program is") from None
        return _output([server, "replay", "--export", str(recording)])

    def inspect(self, checkpoint: Path) -> dict[str, Any]:
        """What the trainer says of a checkpoint. ValueError where it refuses it."""
        return json.loads(_output([self.trainer, "inspect", "--json", str(checkpoint)]))

    def defaults(self, checkpoint: Path, out: Path, keys: Sequence[str]) -> None:
        """Writes the checkpoint with other defaults. ValueError where the trainer refuses."""
        _output([self.trainer, *defaults_words(checkpoint, out, keys)])

    def probe(self, checkpoint: Path, data: Path) -> list[dict[str, Any]]:
        """How well the latent knows the context that a data set tells, in rows. ValueError where there is none."""
        return json.loads(_output([self.trainer, "probe", "--json", str(checkpoint), str(data)]))


def defaults_words(checkpoint: Path, out: Path, keys: Sequence[str]) -> list[str]:
    """The words after `ada-trainer`; keys as `sampler.kappa=0.1`."""
    return ["defaults", str(checkpoint), str(out), *(word for key in keys for word in ("--set", key))]


def defaults_line(checkpoint: Path, out: Path, keys: Sequence[str]) -> str:
    """The same as a line for a shell."""
    return shlex.join(["ada-trainer", *defaults_words(checkpoint, out, keys)])


def _find(name: str, folder: Path | None) -> str:
    found = shutil.which(name, path=str(folder)) if folder else shutil.which(name) or shutil.which(name, path=str(BUILT))
    if found is None:
        place = str(folder) if folder else f"the PATH or {BUILT}"
        raise ValueError(f"there is no {name} in {place}: `make build` makes it, --programs DIR says where it is")
    return found


def _output(command: Sequence[str]) -> str:
    done = subprocess.run(leashed(command), capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ValueError(f"{Path(command[0]).name} {command[1]}: {_last_line(done.stderr) or f'ended with {done.returncode}'}")
    return done.stdout


def _last_line(text: str) -> str:
    return (text.strip().splitlines() or [""])[-1].strip()


def leashed(command: Sequence[str]) -> list[str]:
    """The command, to be started from this process alone: it ends with it, kill -9 or not."""
    return [sys.executable, "-I", "-S", leash.__file__, str(os.getpid()), *command]


@contextmanager
def serving(programs: Programs, models: Path, default: str, log: Path, *settings: str) -> Iterator[Client]:
    """A client of a server of one's own, on loopback, over the folder `models`; it is gone afterwards."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        address = f"127.0.0.1:{free.getsockname()[1]}"
    command = [programs.server, "--listen", address, "--models", str(models), "--default-model", default]
    command += [word for setting in settings for word in ("--set", setting)]
    # In a session of its own: Ctrl-C ends this program, which then ends the server.
    with log.open("wb") as sink, terminated_is_ended():
        server = subprocess.Popen(leashed(command), stdout=sink, stderr=sink, start_new_session=True)
        try:
            _wait_ready(server, f"grpc://{address}", log)
            with Client(f"grpc://{address}") as client:
                yield client
        finally:
            stop(server)


def stop(process: subprocess.Popen[Any]) -> None:
    """Tells it to end, and kills it when it does not."""
    process.terminate()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _wait_ready(server: subprocess.Popen[bytes], address: str, log: Path) -> None:
    with Client(address) as client:
        for _ in range(int(READY_S)):
            try:
                return client.wait_ready(1.0)
            except Unavailable:
                if server.poll() is not None:
                    break
    raise ValueError(f"ada-server does not get ready: {_last_line(log.read_text(errors='replace'))}")


@contextmanager
def terminated_is_ended() -> Iterator[None]:
    """SIGTERM ends this program as an exception does, so that what it started goes too."""

    def leave(number: int, frame: FrameType | None) -> None:
        sys.exit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
