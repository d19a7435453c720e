"""`ada-suite report`: statistics over training seeds and episodes, and pages of finished cells."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from server import ROOT

from ada_diffuser.commands.suite import main
from ada_diffuser.suite.report.results import Group
from ada_diffuser.suite.report.tables import estimate

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
