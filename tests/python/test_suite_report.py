"""`ada-suite report`: statistics over training seeds and episodes, and pages of finished cells."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from server import ROOT

from ada_diffuser.commands.suite import main
from ada_diffuser.suite.report import tables
from ada_diffuser.suite.report.results import Estimate, Group, Results
from ada_diffuser.suite.report.tables import estimate
from ada_diffuser.suite.suite import Suite

GOLDEN = ROOT / "tests/golden/suite"


def group(**returns: list[float]) -> Group:
    """By training seed: `s0=[..]`."""
    return Group([{"seed": int(name[1:]), "returns": values, "failures": 1} for name, values in returns.items()])


def test_standard_errors_are_over_seeds_and_over_episodes() -> None:
    one, other = group(s0=[-10.0, -14.0], s1=[-20.0, -22.0], s2=[-30.0, -36.0]), group(s1=[-21.0, -24.0], s2=[-30.0, -38.0])
    assert one.estimate.mean == -22 and one.median == -21 and one.failures == 3
    assert one.estimate.over_episodes == pytest.approx(np.std([-20, -24], ddof=1) / np.sqrt(2))
    assert one.estimate.over_seeds == pytest.approx(np.std([-12, -21, -33], ddof=1) / np.sqrt(3))
    gap = one.less(other)
    assert gap is not None and gap.mean == 1.25, "of the seeds that both have"
    assert gap.over_seeds == pytest.approx(np.std([1.5, 1.0], ddof=1) / np.sqrt(2))
    assert gap.over_episodes == pytest.approx(np.std([0.5, 2.0], ddof=1) / np.sqrt(2))
    assert one.less(group(s7=[0.0, 0.0])) is None
    assert estimate(group(s0=[-10.0, -14.0]).estimate) == "-12.0 ± - ± 2.0" and estimate(None) == "-"


def test_a_smaller_budget_is_told_with_the_scale() -> None:
    suite = Suite.load(GOLDEN / "golden.toml")
    results = Results.load(suite, GOLDEN / "cells")
    assert "All methods" not in tables.scale(results)
    here = replace(suite.environments["point-wind-s"], keys=("stages.denoise.steps=7", "sampler.kappa=0.0"))
    text = tables.scale(replace(results, suite=replace(suite, environments={"point-wind-s": here})))
    assert " All methods of point-wind-s have `stages.denoise.steps=7`, `sampler.kappa=0.0`. Machine: " in text


def test_the_order_is_told_in_words_beside_the_papers(tmp_path: Path) -> None:
    """What is clear, what is not, and what the paper has otherwise."""

    def cells(name: str, *means: float) -> Group:
        spread = np.array([-1.0, 0.0, 1.0])
        return Group([{"seed": seed, "returns": list(mean + spread * (1 + 0.1 * seed)), "failures": 0} for seed, mean in enumerate(means)])

    suite = replace(
        Suite.load(GOLDEN / "golden.toml"),
        episodes=3,
        environments={"here": None, "there": None},
        methods={name: SimpleNamespace(name=name) for name in ("ours", "above", "level", "below", "nobody")},
        paper={"here": {"ours": -10, "above": -12.0, "level": -20, "below": "-1 (made up)"}},
    )
    found = {"ours": (-10, -10.2), "above": (-5, -5.1), "level": (-9, -11.5), "below": (-30, -31)}
    groups = {(place, name, "cold"): cells(name, *means) for name, means in found.items() for place in ("here", "there")}
    del groups["there", "level", "cold"]
    groups["there", "below", "cold"].files.pop()
    results = Results(suite, groups, 0, 0, 0)
    text = tables.order(results, "cold")
    assert text is not None and tables.order(results, "streaming") is None
    _, here, there = text.split("\n- ")
    assert (
        here.startswith("here: above above (+5.1; ")
        and "; not told apart from level (-0.2; 0.1; less in 3 of 6 episodes)" in here
        and "; below below (-20.4; " in here
    )
    assert here.endswith("**The other way round in the paper: above. Apart in the paper and not here: level.**")
    # Less by the same in every episode: nothing spreads, and nothing is clearer.
    assert there.endswith("; below below (-20.0; inf; 1 of 2 training seeds).") and "of 2" not in here
    assert "level" not in there and there.endswith(".") and "paper" not in there
    gap = groups["here", "below", "cold"].less(groups["here", "ours", "cold"])
    assert gap is not None and gap.in_errors == pytest.approx(gap.mean / np.hypot(gap.over_seeds, gap.over_episodes))
    assert groups["here", "below", "cold"].worse_than(groups["here", "ours", "cold"]) == (6, 6)
    assert Estimate(3.0, None, 0.5).in_errors == 6.0 and Estimate(3.0, None, None).in_errors == 0.0
    assert Estimate(-3.0, 0.0, 0.0).in_errors == -np.inf and Estimate(0.0, 0.0, 0.0).in_errors == 0.0


def test_a_report_of_the_same_cells_is_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    for name in ("a", "b"):
        assert main(["report", str(GOLDEN / "golden.toml"), "--cells", str(GOLDEN / "cells"), "--out", str(tmp_path / name)]) == 0
    written = sorted(path.name for path in (tmp_path / "a").iterdir())
    kinds = ("returns", "probe", "latents", "plans", "cost", "looks-model.latent.looks.block")
    assert written == sorted(["README.md", *(f"golden-{kind}.png" for kind in kinds)])
    assert capsys.readouterr().out.count("golden-") == 2 * len(kinds)
    for name in written:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    text = (tmp_path / "a/README.md").read_text(encoding="utf-8")
    assert text == (GOLDEN / "expected.txt").read_text(encoding="utf-8")
    for table in [part for part in text.split("\n\n") if part.startswith("| ")]:
        assert len({row.replace("\\|", "").count("|") for row in table.splitlines()}) == 1
    assert all(f"({name})" in text for name in written if name != "README.md")


def test_the_report_that_ships_is_of_the_cells_that_ship(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever commits a cell, or changes a suite or a method, makes the report anew: `ada-suite report`."""
    monkeypatch.chdir(ROOT)
    assert main(["report", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert text == (ROOT / "report/README.md").read_text(encoding="utf-8")
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert pictures == {path.name for path in (ROOT / "report").glob("*.png")} and all(f"({name})" in text for name in pictures)


def test_a_report_leaves_out_what_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one cell there is something to tell; suites that nobody has begun are left out, unless they are named."""
    (tmp_path / "report/suites").mkdir(parents=True)
    for name in ("golden", "other"):
        shutil.copy(GOLDEN / "golden.toml", tmp_path / f"report/suites/{name}.toml")
    monkeypatch.chdir(tmp_path)
    cell = Path("report/cells/golden/point-wind-s/diffuser/seed0-cold.json")
    cell.parent.mkdir(parents=True)
    shutil.copy(GOLDEN / "cells/golden/point-wind-s/diffuser/seed0-cold.json", cell)
    assert main(["report"]) == 0
    text = Path("report/README.md").read_text(encoding="utf-8")
    assert "1 of 14 measurements are there" in text and "| ours | - | -20.5 |" in text and "Suite `other`" not in text
    assert "What the latents" not in text and not Path("report/golden-latents.png").exists()
    assert main(["report", "report/suites/golden.toml", "report/suites/other.toml"]) == 0
    assert "Suite `other`: nothing is finished." in Path("report/README.md").read_text(encoding="utf-8")


def test_a_report_says_what_is_not_of_today(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Numbers of a recipe that was changed since are shown as such, and those of other episodes not at all."""
    monkeypatch.chdir(ROOT)
    text = (GOLDEN / "golden.toml").read_text(encoding="utf-8")
    suite, words = tmp_path / "golden.toml", ["--cells", str(GOLDEN / "cells"), "--out", str(tmp_path)]
    suite.write_text(text.replace('set = ["losses', 'set = ["losses.denoise.first_action_weight=5", "losses'), encoding="utf-8")
    assert main(["report", str(suite), *words]) == 0
    assert "the others are -. 1 were measured before the suite" in (tmp_path / "README.md").read_text(encoding="utf-8")
    suite.write_text(text.replace("episodes = 5", "episodes = 6"), encoding="utf-8")
    assert main(["report", str(suite), *words]) == 1
    assert "there is no finished cell" in capsys.readouterr().err
