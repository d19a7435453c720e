"""What an environment says of its episodes beside their returns, D4RL's scores among it, wherever results are told."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from server import ROOT
from test_rollout import finished

from ada_diffuser import environments
from ada_diffuser.rollout import Episode
from ada_diffuser.rollout.readout import Reading
from ada_diffuser.rollout.report import markdown, outcome, table
from ada_diffuser.rollout.seeds import by_recipe
from ada_diffuser.suite.measure import _measures
from ada_diffuser.suite.report import tables
from ada_diffuser.suite.report.results import Group, Results
from ada_diffuser.suite.suite import Suite

D4RL = {
    "walker2d": (1.629008, 4592.3),
    "maze2d-umaze": (23.85, 161.86),
    "maze2d-medium": (13.13, 277.39),
    "maze2d-large": (6.7, 273.99),
    "kitchen-mixed": (0.0, 4.0),
    "kitchen-partial": (0.0, 4.0),
}
"""Reference returns: random, expert (`d4rl/infos.py`)."""


@pytest.mark.parametrize("name", D4RL)
def test_scores_are_on_d4rls_scale(name):
    env, (random, expert) = environments.make(name), D4RL[name]
    for earned, score in ((random, 0.0), (expert, 100.0), ((random + expert) / 2, 50.0)):
        assert environments.measures(env, earned)["score"] == pytest.approx(score)


def test_an_environment_without_words_for_it_says_nothing():
    assert environments.measures(environments.make("point-wind-s"), -3.0) == {}
    assert environments.measures(gym.make("Pendulum-v1"), -3.0) == {}


def episodes(scores, successes):
    return [
        Episode(seed, rewards=[score], measures={"score": score, "success": success})
        for seed, (score, success) in enumerate(zip(scores, successes, strict=True))
    ]


def test_their_means_and_errors_stand_in_tables_lines_and_json():
    result = finished("maze2d-umaze", episodes([10.0, 20.0, 60.0], [1.0, 0.0, 1.0]))
    score, success = result.measures["score"], result.measures["success"]
    error = np.std([10, 20, 60], ddof=1) / np.sqrt(3)
    assert (score.mean, success.mean) == (30.0, pytest.approx(2 / 3)) and score.standard_error == pytest.approx(error)
    stored = json.loads(json.dumps(result.as_json(), allow_nan=False))["measures"]
    assert stored["score"] == {"mean": 30.0, "standard_error": pytest.approx(error, abs=1e-5), "values": [10.0, 20.0, 60.0]}
    shown = f"30.00 ± {error:.2f}"
    assert f"score               {shown}\n" in table([Reading(result, "", None)])
    assert f", score {shown}, success 0.67 ± 0.33" in outcome(result)
    plain = finished("point-wind-s", [Episode(0, rewards=[1.0])])
    rows = markdown([result, plain], []).splitlines()
    assert rows[0].startswith("| environment | model | return | score | success | median |") and len({row.count("|") for row in rows}) == 1
    assert f" | {shown} | 0.67 ± 0.33 | 20.00 |" in rows[2] and "| 1.00 ± 0.00 |  |  | 1.00 |" in rows[3]
    assert "measures" not in plain.as_json() and "score" not in markdown([plain], [])


def test_training_seeds_share_episodes_whose_scores_are_averaged_first():
    results = []
    for seed, scores in enumerate(([10.0, 20.0], [30.0, 60.0])):
        result = finished("maze2d-umaze", episodes(scores, [1.0, 1.0]))
        results.append(replace(result, model=replace(result.model, name=f"a-seed{seed}")))
    (group,) = by_recipe(results)
    assert group.measures["score"].values == [20.0, 40.0] and group.measures["score"].standard_error == pytest.approx(10.0)
    assert group.as_json()["measures"]["score"]["mean"] == 30.0
    assert "30.00 ± 10.00" in markdown(results, []).splitlines()[4].split("|")[5]


def test_a_cell_keeps_each_episodes_and_the_report_has_both_errors():
    result = finished("maze2d-umaze", episodes([10.12341, 20.0], [1.0, 0.0]))
    assert _measures(result) == {"score": [10.1234, 20.0], "success": [1.0, 0.0]}
    files = [
        {"seed": seed, "returns": [1.0, 2.0], "failures": 0, "measures": {"score": scores}}
        for seed, scores in enumerate(([10.0, 20.0], [30.0, 60.0]))
    ]
    group = Group(files)
    score = group.measures["score"]
    assert score.mean == 30 and score.over_seeds == pytest.approx(15.0) and score.over_episodes == pytest.approx(10.0)
    assert Group([{"seed": 0, "returns": [1.0], "failures": 0}]).measures == {}, "cells from before say nothing"
    golden = Suite.load(ROOT / "tests/golden/suite/golden.toml")
    suite = replace(golden, seeds=(0, 1), episodes=2, environments={"here": None}, methods={"ours": SimpleNamespace(name="ours")}, paper={})
    text = tables.returns(Results(suite, {("here", "ours", "cold"): group}, 0, 0, 0), "cold")
    assert "<br>score 30.0 ± 15.0 ± 10.0<br>1.50, 0 of 4 failed" in text
    assert "what an environment says of its episodes, with the same two errors: score" in text
    del files[0]["measures"], files[1]["measures"]
    assert "score" not in tables.returns(Results(suite, {("here", "ours", "cold"): Group(files)}, 0, 0, 0), "cold")
