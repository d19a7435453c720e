"""The table of what experts earn is what was measured, and its script measures what it says."""

from __future__ import annotations

import json
import re
import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest
from server import ROOT

from ada_diffuser import environments

sys.path.insert(0, str(ROOT))
from tests import worlds

ROWS = json.loads((ROOT / "docs/worlds.json").read_text(encoding="utf-8"))


def test_every_row_is_of_an_environment_there_is_and_the_readme_prints_each():
    table = re.findall(
        r"^\| `[\w-]+` \| (?:aware|blind) \|.*$", (ROOT / "clients/python/README.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert table == [worlds.line(row) for row in ROWS]
    assert {row["environment"] for row in ROWS} <= set(environments.NAMES)
    assert all(row["standard_error"] > 0 and 0 <= row["failures"] <= row["episodes"] for row in ROWS)


@pytest.mark.parametrize(("blind", "told"), [(False, None), (True, np.zeros(2))])
def test_a_row_is_the_experts_returns_on_the_seeds_it_says(blind, told):
    expert = worlds.expert_of(
        "point-wind-s", Namespace(experts=Path("nowhere"), as_kept=False, searches=None, iterations=None), blind=blind
    )
    row = worlds.measured("point-wind-s", expert, 3)
    env, returns = environments.make("point-wind-s"), []
    for seed in (1000, 1001, 1002):
        observation, total = env.reset(seed=seed)[0], 0.0
        for _ in range(200):
            action = env.unwrapped.expert_action(observation, env.unwrapped.context if told is None else told)
            observation, reward, *_ = env.step(np.clip(action, -1, 1).astype(np.float32))
            total += reward
        returns.append(total)
    assert row["mean"] == pytest.approx(np.mean(returns), abs=1e-3)
    assert row["standard_error"] == pytest.approx(np.std(returns, ddof=1) / 3**0.5, abs=1e-3)
    assert row["failures"] == sum(total < -60 for total in returns) and row["search"] is None


def test_rows_take_the_place_of_older_ones_of_the_same(tmp_path):
    path = tmp_path / "rows.json"
    old, new, other = ({"environment": name, "expert": "blind", "mean": mean} for name, mean in (("a", 1), ("a", 2), ("b", 3)))
    environments.NAMES.update(a="x/A-v0", b="x/B-v0")
    try:
        worlds.write([other, old], path)
        worlds.write([new], path)
    finally:
        del environments.NAMES["a"], environments.NAMES["b"]
    assert json.loads(path.read_text()) == [new, other]
