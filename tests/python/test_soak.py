"""The soak in short: counters add up after some seconds of mixed work, and a server that leaks is found out."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from server import ROOT
from tests.soak.trend import slope

MINUTES = "0.15"


def soak(tmp_path: Path, *words: str) -> tuple[int, str, dict[str, Any]]:
    kept = tmp_path / "soak.json"
    command = [sys.executable, "-m", "tests.soak", "--minutes", MINUTES, "--json", str(kept), *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)
    assert kept.exists(), done.stdout + done.stderr
    return done.returncode, done.stdout + done.stderr, json.loads(kept.read_text())


def test_memory_stays_and_counters_add_up(tmp_path: Path) -> None:
    status, said, told = soak(tmp_path)
    assert status == 0, said
    assert told["done"].keys() >= {"lives", "has_family", "leaves", "is_hurried", "is_wrong", "hangs_up", "comes_in_crowds", "looks_on"}
    assert "growth_mb=" in said and "growth_percent_per_hour=" in said


def test_a_leak_is_found(tmp_path: Path) -> None:
    status, said, told = soak(tmp_path, "--control", "leak")
    missed = [row["case"] for row in told["rows"] if not row["passes"]]
    assert status == 1 and len(missed) == 1 and missed[0].startswith("memory: growth in"), said


def test_wild_samples_do_not_move_a_slope() -> None:
    rng = np.random.default_rng(0)
    samples = [(t, 5.0 + 0.25 * t + (50.0 if rng.random() < 0.2 else 0.0)) for t in range(2_000)]
    assert slope(samples) == pytest.approx(0.25, abs=0.005)
