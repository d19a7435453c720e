"""TensorBoard's own reader on the trainer's event files: a curve is what log.jsonl holds, whatever stopped the run in between."""

from __future__ import annotations

import collections
import json
import subprocess
from pathlib import Path

from server import ROOT
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

TRAINER = ROOT / "target" / "release" / "ada-trainer"
SIZES = ("stages.identify.steps=30", "stages.denoise.steps=20", "checkpoint_every=5", "log_every=1")


def train(out: Path, *flags: str, sizes: tuple[str, ...] = SIZES) -> subprocess.CompletedProcess[str]:
    sets = [part for size in sizes for part in ("--set", size)]
    command = [str(TRAINER), "run", "tests/golden/small.toml", "--out", str(out), *sets, *flags]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def assert_curves_are_the_log(out: Path) -> dict[str, list[float]]:
    logged: dict[str, list[float]] = collections.defaultdict(list)
    for line in (out / "training" / "log.jsonl").read_text().splitlines():
        row = json.loads(line)
        stage = row.pop("stage")
        attempt = row.pop("attempt")
        row.pop("step")
        for key, value in row.items():
            logged[f"{stage}.attempt{attempt}/{key}" if attempt else f"{stage}/{key}"].append(value)
    reader = EventAccumulator(str(out / "training"), size_guidance={"scalars": 0})
    reader.Reload()
    assert sorted(reader.Tags()["scalars"]) == sorted(logged)
    for tag, values in logged.items():
        events = reader.Scalars(tag)
        assert len(events) == len(values), tag
        assert all(abs(event.value - value) <= 1e-5 * abs(value) for event, value in zip(events, values, strict=True)), tag
        steps = [event.step for event in events]
        assert steps == sorted(set(steps)), tag
    return logged


def test_a_resume_in_the_second_stage_keeps_the_curves_of_the_first(tmp_path: Path) -> None:
    """Going on at step 5 of the second stage dropped all that the first had beyond its step 5, and the step that was saved last."""
    out = tmp_path / "run"
    for steps in (12, 23):
        assert train(out, "--stop-after-steps", str(steps)).returncode == 0
        assert_curves_are_the_log(out)
    assert train(out).returncode == 0
    logged = assert_curves_are_the_log(out)
    assert (len(logged["identify/elbo"]), len(logged["denoise/loss"])) == (30, 20)


def test_a_second_attempt_keeps_the_curves_of_the_first(tmp_path: Path) -> None:
    """Stopped in the second attempt at a gate and continued, the first attempt's curves were cut at that step."""
    out = tmp_path / "run"
    sizes = (*SIZES, "stages.identify.gate.filter=0.0", "stages.identify.gate.successor_state=0.0", "stages.identify.gate.tries=3")
    assert train(out, "--stop-after-steps", "37", sizes=sizes).returncode == 0
    assert_curves_are_the_log(out)
    assert train(out, sizes=sizes).returncode == 1
    logged = assert_curves_are_the_log(out)
    assert [len(logged[f"identify{attempt}/elbo"]) for attempt in ("", ".attempt1", ".attempt2")] == [30, 30, 30]
