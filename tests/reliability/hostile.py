"""Checkpoints that were made to harm, or mistyped, beside a good one.

Each is harmed and then sealed: its manifest has the right digests again, so that it is not the digest that refuses it. One is sealed and
not harmed, and must be served.
"""

from __future__ import annotations

import copy
import hashlib
import json
import os
import shutil
import struct
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from .process import MB, ROOT, Row, Server, refused_by

TINY = ROOT / "models" / "tiny"
WEIGHTS, CONFIG, MANIFEST = "model.safetensors", "config.json", "manifest.json"
GOOD, SEALED = "good", "sealed"
#: Refused for the digest alone, which is what these are to show.
UNSEALED = ("flip", "cut", "gone", "pipe", "directory", "device", "manifest")
Json = dict[str, Any]
Tensor = tuple[str, str, list[int], bytes]


@dataclass
class Checkpoint:
    """Models/tiny, to be harmed."""

    config: Json = field(default_factory=lambda: json.loads((TINY / CONFIG).read_text()))
    tensors: list[Tensor] = field(default_factory=lambda: _tensors((TINY / WEIGHTS).read_bytes()))
    #: In the place of what config and tensors say.
    config_bytes: bytes | None = None
    weight_bytes: bytes | None = None

    def write(self, model: Path) -> None:
        """With a manifest that is right for it."""
        model.mkdir()
        config = json.dumps(self.config).encode() if self.config_bytes is None else self.config_bytes
        weights = _safetensors(self.tensors) if self.weight_bytes is None else self.weight_bytes
        manifest = json.loads((TINY / MANIFEST).read_text())
        manifest["tensors"] = {name: {"shape": shape, "sha256": _sha256(data)} for name, _, shape, data in self.tensors}
        manifest["files"] = {CONFIG: _sha256(config), WEIGHTS: _sha256(weights)}
        for name, data in ((CONFIG, config), (WEIGHTS, weights), (MANIFEST, json.dumps(manifest).encode())):
            (model / name).write_bytes(data)


def measure() -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as place:
        models = Path(place)
        shutil.copytree(TINY, models / GOOD)
        alone = _start(models)
        for name, harm in _cases().items():
            harm(models / name)
        beside = _start(models)
        names = sorted(set(_cases()) - {SEALED})
    refused, why = beside["ms"], beside["why"]
    missed = [name for name in names if name not in refused]
    unsealed = [name for name in names if "SHA-256" in why.get(name, "") and not name.startswith(UNSEALED)]
    if missed or unsealed:
        print("not refused by name:", missed, "refused for a digest alone:", unsealed)
    yield Row("hostile", "checkpoints refused by name", len(names) - len(missed), len(names), "", at_least=True)
    yield Row("hostile", "of them for a digest, where another reason is meant", len(unsealed), 0, "")
    yield Row("hostile", "good ones served, one of them sealed anew", len(beside["served"] & {GOOD, SEALED}), 2, "", at_least=True)
    yield Row("hostile", "others served", len(beside["served"] - {GOOD, SEALED}), 0, "")
    yield Row("hostile", "time of the slowest refusal", max(refused.values(), default=0.0), 200, "ms")
    yield Row("hostile", "memory of all together, at the most", (beside["memory"] - alone["memory"]) / MB, 64, "MB")


def _start(models: Path) -> dict[str, Any]:
    """Starts a server over these models, and says what became of them: why each was refused, and how long that took."""
    with tempfile.TemporaryFile("w+") as log, Server(f"models.default={GOOD}", models=models, log=log) as server:
        served, memory = server.models(), server.memory("VmHWM")
        server.stop()
        log.seek(0)
        events = [json.loads(line) for line in log]
    at = [datetime.fromisoformat(event["timestamp"].replace("Z", "+00:00")) for event in events]
    ms, why = {}, {}
    for event, before, now in zip(events[1:], at, at[1:], strict=False):
        if name := refused_by(event):
            ms[name], why[name] = (now - before).total_seconds() * 1e3, str(event)
    return {"served": served, "memory": memory, "ms": ms, "why": why}


def _cases() -> dict[str, Callable[[Path], None]]:
    cases: dict[str, Callable[[Path], None]] = {SEALED: Checkpoint().write}

    def sealed(name: str, change: Callable[[Checkpoint], object]) -> None:
        checkpoint = Checkpoint()
        change(checkpoint)
        cases[name] = checkpoint.write

    plan = "method.plan"
    for path in (f"{plan}.horizon", "method.latent.looks.block", f"{plan}.obs_horizon", f"{plan}.level_max"):
        for value in (0, -1, 10**12):
            sealed(f"absurd-{path}-{value}", lambda one, path=path, value=value: _set(one.config, path, value))
    absurd = {
        "method.latent.dim": 10**9,
        "layout.state_dim": 10**9,
        f"{plan}.backbone.widths": [10**9],
        f"{plan}.clip": 0,
        "units.action_low.0": 5.0,
        "defaults.sampler.sub_steps": 2**61,
        "defaults.sampler.action_horizon": 10**9,
        "defaults.sampler.kappa": -1.0,
        "defaults.sampler.temperature": -1.0,
    }
    for path, value in absurd.items():
        sealed(f"absurd-{path}", lambda one, path=path, value=value: _set(one.config, path, value))
    leaves = dict(_leaves(Checkpoint().config))
    for path in list(leaves)[:8]:
        sealed(f"mistyped-{path}", lambda one, path=path: _rename(one.config, path))
    numbers = [path for path, value in leaves.items() if isinstance(value, (int, float)) and not isinstance(value, bool)]
    for path in numbers[:6]:
        sealed(f"worded-{path}", lambda one, path=path: _set(one.config, path, str(leaves[path])))
        sealed(f"listed-{path}", lambda one, path=path: _set(one.config, path, [leaves[path]]))
    for name, text in {"deep": b"[" * 500_000, "text": b"\xff" * 100, "empty": b"", "large": b"{" + b" " * 5_000_000}.items():
        sealed(f"config-{name}", lambda one, text=text: setattr(one, "config_bytes", text))
    _harm_weights(sealed)
    _harm_files(cases)
    return cases


def _harm_weights(sealed: Callable[[str, Callable[[Checkpoint], object]], None]) -> None:
    first = Checkpoint().tensors[0]
    name, _, shape, data = first

    def filled(value: float) -> bytes:
        return struct.pack("<f", value) * (len(data) // 4)

    others: dict[str, Tensor] = {
        "nan": (name, "F32", shape, filled(float("nan"))),
        "inf": (name, "F32", shape, filled(float("inf"))),
        "f16": (name, "F16", [2 * shape[0], *shape[1:]], data),
        "shape": (name, "F32", [1, *shape], data),
        "renamed": (f"{name}x", "F32", shape, data),
    }
    for word, tensor in others.items():
        sealed(f"weights-{word}", lambda one, tensor=tensor: one.tensors.__setitem__(0, tensor))
    sealed("weights-missing", lambda one: one.tensors.pop(0))
    sealed("weights-extra", lambda one: one.tensors.append(("extra", "F32", [1], bytes(4))))
    sealed("weights-twice", lambda one: setattr(one, "weight_bytes", _safetensors([*one.tensors, one.tensors[0]])))
    heads = {"zero": 0, "one": 1, "large": 88_000_000, "huge": 2**64 - 1}
    for word, length in heads.items():
        data = length.to_bytes(8, "little") + _safetensors(Checkpoint().tensors)[8:]
        sealed(f"head-{word}", lambda one, data=data: setattr(one, "weight_bytes", data))
    deep = (100_000).to_bytes(8, "little") + b"[" * 100_000
    sealed("head-deep", lambda one: setattr(one, "weight_bytes", deep))
    sealed("weights-padded", lambda one: setattr(one, "weight_bytes", _safetensors(one.tensors) + bytes(1000)))
    sealed("weights-88-mb", lambda one: setattr(one, "weight_bytes", _safetensors(one.tensors) + bytes(88_000_000)))


def _harm_files(cases: dict[str, Callable[[Path], None]]) -> None:
    """What is in the place of the files, and what an unsealed one has in it."""

    def of(name: str, file: str, change: Callable[[Path], object]) -> None:
        def harm(model: Path) -> None:
            shutil.copytree(TINY, model)
            change(model / file)

        cases[f"{name}-{file.split('.')[0]}"] = harm

    for file in (WEIGHTS, CONFIG, MANIFEST):
        of("gone", file, Path.unlink)
        of("pipe", file, _replaced(os.mkfifo))
        of("directory", file, _replaced(Path.mkdir))
        of("device", file, _replaced(lambda path: path.symlink_to("/dev/zero")))
        of("cut", file, lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]))
        of("flip", file, lambda path: path.write_bytes(_flipped(path.read_bytes())))


def _replaced(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        path.unlink()
        make(path)

    return change


def _flipped(data: bytes) -> bytes:
    at = data.index(b'"sha256": "') + 12 if b'"sha256": "' in data else len(data) // 2
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


def _leaves(config: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """All values that are no objects, by dotted path."""
    for name, value in config.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _rename(config: dict[str, Any], path: str) -> None:
    """Mistypes the last name of a dotted path."""
    *parents, name = path.split(".")
    for parent in parents:
        config = config[parent]
    config[f"{name}x"] = config.pop(name)


def _set(config: Json, path: str, value: object) -> None:
    *parents, last = path.split(".")
    at: Any = config
    for key in parents:
        at = at[key]
    at[int(last) if isinstance(at, list) else last] = copy.deepcopy(value)


def _tensors(data: bytes) -> list[Tensor]:
    length = int.from_bytes(data[:8], "little")
    head, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    head.pop("__metadata__", None)
    return [(name, one["dtype"], one["shape"], body[slice(*one["data_offsets"])]) for name, one in head.items()]


def _safetensors(tensors: list[Tensor]) -> bytes:
    """By hand, for a writer would not name a tensor twice."""
    entries, body = [], b""
    for name, dtype, shape, data in tensors:
        about = {"dtype": dtype, "shape": shape, "data_offsets": [len(body), len(body) + len(data)]}
        entries.append(f"{json.dumps(name)}: {json.dumps(about)}")
        body += data
    head = ("{" + ", ".join(entries) + "}").encode()
    return len(head).to_bytes(8, "little") + head + body


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
