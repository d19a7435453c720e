"""What a cell does: collect, train, probe, serve, roll out. Killed at any moment, it goes on where it was."""

from __future__ import annotations

import fcntl
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ada_diffuser.commands.outputs import save_json, save_text
from ada_diffuser.commands.programs import Programs, leashed, serving, stop
from ada_diffuser.dataset import card_path
from ada_diffuser.suite.cell import Cell, Places, found
from ada_diffuser.suite.machine import machine
from ada_diffuser.suite.measure import measured
from ada_diffuser.suite.suite import Mode
from ada_diffuser.suite.toml import loads

#: What the files of a served checkpoint are.
_CHECKPOINT = ("config.json", "model.safetensors", "manifest.json")
#: How often the time that a training took is written down.
_TICK_S = 5.0


def work(cell: Cell, places: Places, programs: Programs, cells_at_once: int) -> None:
    """Writes the files that the cell misses. ValueError with the step that failed."""
    with _alone(cell.log(places)):
        modes = cell.missing(places)
        if not modes:
            return _say("nothing is missing")
        data = _data(cell, places)
        run, seconds = _trained(cell, places, programs, data)
        served = places.runs / cell.suite.name / "served" / cell.name
        told = programs.inspect(_served(cell, programs, run, served / "models/model"))
        facts = _facts(cell, told, data) | {
            "probe": _probed(programs, told, run, data),
            "train_seconds": round(seconds, 1),
            "machine": machine(cells_at_once),
        }
        with serving(programs, served / "models", "model", served / "server.log", "engine.workers=1", "server.io_threads=1") as client:
            for mode in modes:
                _say(f"{mode}: {cell.suite.episodes} episodes from seed {cell.suite.first_seed}")
                _save(_named(cell, mode) | measured(client, cell, mode, "model") | facts, cell.file(places, mode))
        shutil.rmtree(served)


def _save(numbers: dict[str, Any], path: Path) -> None:
    """A line for each key."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f" {json.dumps(name)}: {json.dumps(value, allow_nan=False)}" for name, value in numbers.items()]
    save_text("{\n" + ",\n".join(lines) + "\n}\n", path)
    _say(f"{numbers['mode']}: {numbers['mean']:.2f} ± {numbers['se']:.2f}, {numbers['failures']} failed: {path}")


def _named(cell: Cell, mode: Mode) -> dict[str, Any]:
    method = cell.method
    return {
        "suite": cell.suite.name,
        "method": method.name,
        "environment": cell.environment.name,
        "seed": cell.seed,
        "key": cell.key(mode),
        "varied": dict([method.varied]) if method.varied else None,
    }


def _facts(cell: Cell, told: dict[str, Any], data: Path) -> dict[str, Any]:
    """Of the checkpoint and its data."""
    recipe, card = loads(told["provenance"]["recipe"]), found(card_path(data)) or {}
    return {
        "recipe": str(cell.recipe),
        "with": [str(path) for path in cell.method.changes],
        "set": cell.keys,
        "steps": {stage["name"]: stage["steps"] for stage in recipe["stages"]},
        "parameters": sum(told["parameters"].values()),
        "checkpoint": told["digest"],
        "data": {"episodes": card.get("episodes"), "steps": card.get("steps"), "sha256": told["provenance"]["dataset_sha256"]},
    }


def _data(cell: Cell, places: Places) -> Path:
    """The data set; collected where it is not there yet. The card is written last, so with it all is there."""
    path, world = cell.data(places), cell.environment
    if world.collect is None:
        return path
    with _alone(path):
        if not card_path(path).exists() or not path.exists():
            words = ["--env", world.env, "--out", str(path)]
            words += [] if world.episode_steps is None else ["--episode-steps", str(world.episode_steps)]
            words += [text for name, value in world.options.items() for text in ("--option", f"{name}={json.dumps(value)}")]
            words += [text for flag, value in world.collect.items() for text in (f"--{flag}", str(value))]
            _say(f"collects {path}")
            _run("ada-collect", [sys.executable, "-m", "ada_diffuser.commands.collect", *words])
    return path


def _trained(cell: Cell, places: Places, programs: Programs, data: Path) -> tuple[Path, float]:
    """The folder of the finished training, and how long it took, all its beginnings together."""
    run = cell.training(places)
    clock = run.with_name(f"{run.name}.clock.json")
    with _alone(run):
        before = found(clock) or {"seconds": 0.0, "finished": False}
        if before["finished"] and (run / "manifest.json").exists():
            _say(f"is trained: {run}")
            return run, before["seconds"]
        started = time.monotonic()

        def spent(*, finished: bool = False) -> float:
            seconds = before["seconds"] + time.monotonic() - started
            save_json({"seconds": seconds, "finished": finished}, clock)
            return seconds

        words = ["--seed", str(cell.seed), "--data", str(data), "--out", str(run), "--share-stages", str(places.stages)]
        words += [text for path in cell.method.changes for text in ("--with", str(path))]
        words += [text for key in cell.training_keys for text in ("--set", key)]
        _say(f"trains {run}")
        _run("ada-trainer run", [programs.trainer, "run", str(cell.recipe), *words], spent)
        before["seconds"] += _shared_seconds(run)
        return run, spent(finished=True)


def _shared_seconds(run: Path) -> float:
    """What another training has spent on the stages that this one began behind."""
    lines = map(json.loads, (run / "training/log.jsonl").read_text(encoding="utf-8").splitlines())
    return sum(line.get("shared_seconds", 0.0) for line in lines)


def _served(cell: Cell, programs: Programs, run: Path, model: Path) -> Path:
    """A copy of the checkpoint with the method's defaults."""
    shutil.rmtree(model.parents[1], ignore_errors=True)
    model.mkdir(parents=True)
    for name in _CHECKPOINT:
        shutil.copyfile(run / name, model / name)
    if cell.default_keys:
        programs.defaults(model, model, cell.default_keys)
    return model


def _probed(programs: Programs, told: dict[str, Any], run: Path, data: Path) -> list[dict[str, Any]] | None:
    """The error of a linear probe by what it is told and how many tokens it is shown, of all ages; None where nothing is inferred."""
    import h5py

    with h5py.File(data, "r") as file:
        tells = "infos/context" in file
    if not tells or told["config"]["method"]["latent"]["kind"] != "gru":
        return None
    _say("probes")
    kept = ("evidence", "block_len", "mse", "ceiling")
    return [{name: row.get(name) for name in kept} for row in programs.probe(run, data) if row["age"] is None]


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """One process at a time makes what is at this path; whoever dies lets the next one in."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.with_name(f".{path.name}.lock").open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            _say(f"waits for another process that is at {path}")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _run(name: str, command: Sequence[str], tick: Callable[[], object] = lambda: None) -> None:
    """A program to its end, its words on our own streams; it is told to stop when we are. ValueError where it fails."""
    # In a session of its own: Ctrl-C reaches us alone, and a trainer that is told to stop twice would not write its state down.
    process = subprocess.Popen(leashed(command), start_new_session=True)
    try:
        while process.poll() is None:
            try:
                process.wait(_TICK_S)
            except subprocess.TimeoutExpired:
                tick()
    except BaseException:
        stop(process)
        raise
    if process.returncode != 0:
        raise ValueError(f"{name} ended with {process.returncode}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
