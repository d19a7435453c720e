"""The table of `make bench-peers`: turns, medians, targets. Nothing is timed and PyTorch is not needed."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
from server import ROOT

sys.path.insert(0, str(ROOT / "benches/peers"))
import compare
from machine import Watch
from processes import NotMeasured, run
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


def test_the_folder_of_the_results_is_there_before_anything_is_measured(tmp_path, monkeypatch) -> None:
    """--json into a folder that was not there failed after the first trial."""
    monkeypatch.setattr(compare.signal, "signal", lambda *_: None)
    monkeypatch.setattr(compare.machine, "pin", lambda cores: sys.exit("measuring begins"))
    with pytest.raises(SystemExit, match="measuring begins"):
        compare.main(["--json", str(tmp_path / "new/folder/a.json")])
    assert (tmp_path / "new/folder").is_dir()
