"""The real trainer as a process, and a small data set for it, for the tests of what it reads."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from typing import Any

import h5py
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
TRAINER = Path(os.environ.get("ADA_TRAINER", ROOT / "target/release/ada-trainer"))
RECIPE = ROOT / "tests/golden/small.toml"
EPISODES, STEPS = 12, 24
ROWS = EPISODES * STEPS

Arrays = dict[str, np.ndarray]


def arrays() -> Arrays:
    """Small whole numbers, so that every type holds them exactly."""
    rng = np.random.default_rng(0)
    ends = np.arange(1, ROWS + 1) % STEPS == 0
    return {
        "observations": rng.integers(0, 100, (ROWS, 3)).astype(np.float32),
        "actions": rng.integers(0, 2, (ROWS, 2)).astype(np.float32),
        "rewards": rng.integers(0, 50, ROWS).astype(np.float32),
        "terminals": ends & (np.arange(ROWS) >= ROWS // 2),
        "timeouts": ends & (np.arange(ROWS) < ROWS // 2),
        "infos/context": np.repeat(rng.integers(0, 9, (EPISODES, 1)), STEPS, axis=0).astype(np.float32),
    }


def write(path: Path, columns: Arrays, libver: str = "earliest", **how: Any) -> Path:
    with h5py.File(path, "w", libver=libver) as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, **how)
    return path


def train(data: Path, out: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    command = [TRAINER, "run", RECIPE, "--data", data.absolute(), "--out", out.absolute(), *flags]
    return subprocess.run([str(word) for word in command], capture_output=True, text=True, cwd=ROOT, timeout=300, check=False)


def log(data: Path, out: Path) -> str:
    """The log of a run that has read everything and drawn from all episodes."""
    few = ["--set", "stages.identify.steps=2", "--set", "stages.denoise.steps=2", "--set", "log_every=1"]
    done = train(data, out, *few)
    assert done.returncode == 0, done.stderr
    return (out / "training/log.jsonl").read_text()


def episodes_of(columns: Arrays) -> list[Arrays]:
    return [{name: values[at : at + STEPS] for name, values in columns.items()} for at in range(0, ROWS, STEPS)]
