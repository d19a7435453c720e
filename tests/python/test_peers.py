"""The table of `make bench-peers`: turns, medians, targets. Nothing is timed and PyTorch is not needed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from server import ROOT

sys.path.insert(0, str(ROOT / "benches/peers"))
import compare
import trials as rows
from machine import Watch
from processes import MAKE_RANDOM, TIME_ACTS, NotMeasured, run
from trials import Figures, Goal, Settings, Side, Trial, trials

SETTINGS = Settings(Path("models"), 1.0, 1.0, "eager", 1, "stream")
FASTER = Goal("forward", "ms", "ms", "times faster", 4)


def trial(theirs: list[Figures], ours: list[Figures], *goals: Goal) -> Trial:
    """Sides that answer from lists, and write down whose turn it was."""

    def prepare(_: Settings, __: ExitStack) -> tuple[Side, Side]:
        return lambda: theirs.pop(0), lambda: ours.pop(0)

    return Trial("forward", "a trial", goals, prepare)


def test_the_best_mode_is_chosen_by_its_median() -> None:
    theirs = [{"eager": {"ms": 9.0}, "jit": {"ms": ms}} for ms in (8.0, 1.0, 10.0)]
    ours = [{"ada": {"ms": ms}} for ms in (2.0, 7.0, 1.0)]
    (row,) = compare._measure(trial(theirs, ours, FASTER), SETTINGS, 3, "1/1")
    assert (row.theirs_mode, row.theirs, row.ours, row.score, row.reached) == ("jit", 8.0, 2.0, 4.0, True)
    line = compare._table([row], {FASTER.text: FASTER}).splitlines()[2]
    assert line == "| forward | 8.00 ms (jit) | 2.00 ms | 4x | at least 4x | yes |"


@pytest.mark.parametrize(
    ("kind", "target", "theirs", "ours", "score", "reached"),
    [
        ("times faster", 4.0, 10.0, 5.0, 2.0, False),
        ("times more", 4.0, 10.0, 50.0, 5.0, True),
        ("share", 75.0, 0.8, 1.0, 80.0, True),
        ("times at most", 2.0, 4.0, 9.0, 2.25, False),
        ("at most", 200.0, None, 150.0, 150.0, True),
    ],
)
def test_scores(kind: str, target: float, theirs: float | None, ours: float, score: float, reached: bool) -> None:
    goal = Goal("row", "x", "MB", kind, target)  # type: ignore[arg-type]
    assert goal.score(theirs, ours) == pytest.approx(score)
    assert goal.reached(score) is reached


def test_what_cannot_be_measured_says_why() -> None:
    def prepare(_: Settings, __: ExitStack) -> tuple[Side, Side]:
        return (lambda: {"jit": {"ms": 3.0}}), (lambda: {"ada": {"ms": float(run("/no/such/program")[0]["ms"])}})

    (row,) = compare._measure(Trial("forward", "a trial", (FASTER,), prepare), SETTINGS, 2, "1/1")
    assert (row.theirs, row.ours, row.reached, row.not_measured) == (3.0, None, None, "program is not there")
    table = compare._table([row], {FASTER.text: FASTER})
    assert "| not measured |" in table and "Not measured: program is not there" in table


def test_a_program_that_fails_is_named() -> None:
    with pytest.raises(NotMeasured, match="the last word"):
        run(sys.executable, "-c", "import sys; sys.exit('first\\nthe last word')")
    assert run(sys.executable, "-c", "print('noise'); print('{\"ms\": 1}')") == [{"ms": 1}]


def test_rows_are_told_apart_and_idle_cores_are_idle() -> None:
    texts = [goal.text for one in trials() for goal in one.goals]
    assert len(texts) == len(set(texts)) > 10
    assert Watch([0]).others() >= 0.0


class Programs:
    """Stands for the programs of a row of acts: what each was told, and what it answers."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.told: dict[str, tuple[object, ...]] = {}
        self.ours: dict[str, Any] = {"ms": 2.5, "action": [0.5, -0.25], "value": 1.0}
        self.theirs: list[dict[str, Any]] = [
            {"mode": "eager", "ms": 40.0, "action": [0.5001, -0.25], "value": 1.0},
            {"mode": "jit", "ms": 24.0, "action": [0.5, -0.2501], "value": None},
            {"mode": "compile", "error": "no compiler"},
        ]
        self.load_report = {"acts_per_s": 300.0, "latency_ms": {"p50": 3.0, "p99": 4.0}, "evaluations_per_act": 16.0}
        for name in ("run", "peer", "ada_server"):
            monkeypatch.setattr(rows, name, getattr(self, name))

    def run(self, program: Path, *words: object) -> list[dict[str, Any]]:
        self.told[program.name] = words
        return {MAKE_RANDOM: [], TIME_ACTS: [self.ours]}[program]

    def peer(self, script: str, *words: object) -> list[dict[str, Any]]:
        self.told[script] = words
        return self.theirs

    @contextmanager
    def ada_server(self, models: Path, default: str) -> Iterator[Programs]:
        self.told["server"] = (models / default,)
        yield self

    def load(self, *words: object) -> dict[str, Any]:
        self.told["load"] = words
        return self.load_report

    def options(self, program: str) -> set[object]:
        words = self.told[program]
        return {word for flag, word in pairwise(words) if flag == "--set"}


GUIDED = rows.ACTS[0]


def act_row(programs: Programs) -> compare.Row:
    (one,) = (one for one in trials() if one.name.startswith(GUIDED.text))
    (row,) = compare._measure(one, SETTINGS, 2, "1/1")
    return row


def test_an_act_over_the_wire_is_held_against_a_function(monkeypatch) -> None:
    """Ours is what the client waits for, theirs the best mode of the function alone."""
    programs = Programs(monkeypatch)
    row = act_row(programs)
    assert (row.group, row.theirs_mode, row.theirs, row.ours, row.score, row.target) == ("act", "jit", 24.0, 3.0, 8.0, 8)
    assert row.ours_turns[0]["stream"]["alone"] == 2.5
    model, *_ = programs.told["server"]
    assert {"--out", model, *GUIDED.flags} <= set(programs.told["make_random"])
    for program in ("time_acts", "torch_acts.py"):
        assert model in programs.told[program]
        assert programs.options(program) == {*GUIDED.options, "temperature=0.5"}
    assert programs.options("load") == {*GUIDED.options, "temperature=0.5", "streaming=false"}


@pytest.mark.parametrize("wrong", [{"action": [0.5, -0.26]}, {"value": 1.1}, {"action": [0.5, float("nan")]}])
def test_programs_that_act_otherwise_are_not_compared(monkeypatch, wrong: dict[str, Any]) -> None:
    programs = Programs(monkeypatch)
    programs.theirs[0] |= wrong
    assert act_row(programs).not_measured.startswith("PyTorch (eager) acts otherwise")


def test_an_act_of_other_evaluations_is_not_compared(monkeypatch) -> None:
    programs = Programs(monkeypatch)
    programs.load_report["evaluations_per_act"] = 15.0
    assert act_row(programs).not_measured == "our act took 15.00 evaluations, not 16"


def test_the_acts_are_those_that_were_promised() -> None:
    assert [(act.evaluations, act.options) for act in rows.ACTS] == [
        (16, ("guidance_scale=1.5",)),
        (2 * 16, ("told_return=1", "free_guidance_scale=1.2")),
        (64 * 16, ("candidates=64",)),
        (64 * 5, ("candidates=64",)),
    ]
    assert [goal.target for one in trials() if one.group == "act" for goal in one.goals] == [8, 8, 8, 10]


def test_the_folder_of_the_results_is_there_before_anything_is_measured(tmp_path, monkeypatch) -> None:
    """--json into a folder that was not there failed after the first trial."""
    monkeypatch.setattr(compare.signal, "signal", lambda *_: None)
    monkeypatch.setattr(compare.machine, "pin", lambda cores: sys.exit("measuring begins"))
    with pytest.raises(SystemExit, match="measuring begins"):
        compare.main(["--json", str(tmp_path / "new/folder/a.json")])
    assert (tmp_path / "new/folder").is_dir()
