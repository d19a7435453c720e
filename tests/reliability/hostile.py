"""Checkpoints that were made to harm, or mistyped, beside a good one."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .process import MB, ROOT, Row, Server

TINY = ROOT / "models" / "tiny"
WEIGHTS, CONFIG, MANIFEST = "model.safetensors", "config.json", "manifest.json"
Harm = Callable[[Path], None]


def measure() -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as place:
        models = Path(place)
        shutil.copytree(TINY, models / "good")
        alone = _start(models)
        hostile, mistyped = _hostile(), _mistyped()
        for i, harm in enumerate([*hostile, *mistyped]):
            model = models / f"bad-{i:02}"
            shutil.copytree(TINY, model)
            harm(model)
        beside = _start(models)
    bad = len(hostile) + len(mistyped)
    case = f"{len(hostile)} hostile and {len(mistyped)} mistyped checkpoints: "
    yield Row("hostile", case + "refused by name", len(beside["refused"]), bad, "", at_least=True)
    yield Row("hostile", case + "models served", beside["models"], 1, "")
    yield Row("hostile", case + "time of each", (beside["load_s"] - alone["load_s"]) / bad * 1e3, 200, "ms")
    yield Row("hostile", case + "memory at the most", (beside["memory"] - alone["memory"]) / MB, 64, "MB")


def _start(models: Path) -> dict[str, Any]:
    """Starts a server over these models, and says what became of them."""
    with tempfile.TemporaryFile("w+") as log, Server("models.default=good", models=models, log=log) as server:
        served, memory, processor = server.metric("ada_model_info"), server.memory("VmHWM"), server.processor_s()
        server.stop()
        log.seek(0)
        events = [json.loads(line) for line in log]
    names = {str(event) for event in events if event.get("level") in ("WARN", "ERROR")}
    refused = {path.name for path in models.glob("bad-*") if any(path.name in name for name in names)}
    return {"models": served, "memory": memory, "load_s": processor, "refused": refused}


def _hostile() -> list[Harm]:
    size = (TINY / WEIGHTS).stat().st_size
    cut = [_bytes(WEIGHTS, lambda data, at=at: data[:at]) for at in (0, 1, 7, 8, 100, size // 2, size - 1)]
    flips = [_bytes(WEIGHTS, lambda data, at=at: _flipped(data, at)) for at in range(0, size, size // 13)]
    heads = [
        _bytes(WEIGHTS, lambda data, length=length: length.to_bytes(8, "little") + data[8:])
        for length in (0, 1, 1 << 20, 1 << 40, 2**64 - 1)
    ]
    other = [
        _bytes(WEIGHTS, lambda data: data + b"\0" * 1000),
        _bytes(WEIGHTS, lambda data: b"\0" * len(data)),
        _bytes(WEIGHTS, lambda data: (88_000_000).to_bytes(8, "little") + b"{" + b" " * 88_000_000),
        _bytes(MANIFEST, lambda data: b"[" * 100_000),
        _bytes(CONFIG, lambda data: b"{" + b" " * 5_000_000),
        _bytes(CONFIG, lambda data: data[:-2]),
        _bytes(MANIFEST, lambda data: b""),
        _bytes(CONFIG, lambda data: b"\xff" * 100),
        *[_gone(name) for name in (WEIGHTS, CONFIG, MANIFEST)],
        *[_pipe(name) for name in (WEIGHTS, CONFIG, MANIFEST)],
        *[_directory(name) for name in (WEIGHTS, CONFIG, MANIFEST)],
        *[_link(name) for name in (WEIGHTS, CONFIG, MANIFEST)],
    ]
    sizes = ("plan_horizon", "block_len", "obs_horizon", "level_max")
    absurd = [_config(name, value) for name in sizes for value in (0, -1, 10**12)]
    return [*cut, *flips, *heads, *other, *absurd]


def _mistyped() -> list[Harm]:
    """What somebody who edits a file by hand may do to it."""
    names = json.loads((TINY / CONFIG).read_text())
    renamed = [_edit(CONFIG, lambda config, name=name: config.update({f"{name}x": config.pop(name)})) for name in list(names)[:8]]
    numbers = [name for name, value in names.items() if isinstance(value, (int, float)) and not isinstance(value, bool)]
    worded = [_config(name, str(names[name])) for name in numbers[:6]]
    listed = [_config(name, [names[name]]) for name in numbers[:6]]
    return [*renamed, *worded, *listed]


def _bytes(name: str, change: Callable[[bytes], bytes]) -> Harm:
    return lambda model: (model / name).write_bytes(change((model / name).read_bytes())) and None


def _edit(name: str, change: Callable[[dict[str, Any]], None]) -> Harm:
    def harm(model: Path) -> None:
        content = json.loads((model / name).read_text())
        change(content)
        (model / name).write_text(json.dumps(content))

    return harm


def _config(name: str, value: object) -> Harm:
    return _edit(CONFIG, lambda config: config.update({name: value}))


def _gone(name: str) -> Harm:
    return lambda model: (model / name).unlink()


def _pipe(name: str) -> Harm:
    def harm(model: Path) -> None:
        (model / name).unlink()
        os.mkfifo(model / name)

    return harm


def _directory(name: str) -> Harm:
    def harm(model: Path) -> None:
        (model / name).unlink()
        (model / name).mkdir()

    return harm


def _link(name: str) -> Harm:
    def harm(model: Path) -> None:
        (model / name).unlink()
        (model / name).symlink_to("/dev/zero")

    return harm


def _flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]
