"""Walker2d, and data of the learner that makes its expert: half way, all that it tried, and with the best."""

from __future__ import annotations

import json
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

from ada_diffuser import environments
from ada_diffuser.collect import Job, collect, data_card
from ada_diffuser.commands.collect import main as collect_command
from ada_diffuser.environments import ArsSettings
from ada_diffuser.experts import ExpertRecipe, LinearPolicy, PolicyBank, flights, load_expert, make_expert, recipe_for, save_expert
from ada_diffuser.experts.training import _Course

RECIPE = replace(recipe_for(environments.make("walker2d"), {}, 0), ars=ArsSettings(iterations=25, directions=4, top=2, noise=0.025))


@pytest.fixture(scope="module")
def bank() -> PolicyBank:
    """Of a search of seconds."""
    return make_expert(RECIPE)


def test_it_is_gymnasiums_walker():
    ours, theirs = environments.make("walker2d"), gym.make("Walker2d-v5")
    assert environments.steps_max(ours) == theirs.spec.max_episode_steps == 1000
    ours, theirs = ours.unwrapped, theirs.unwrapped
    for seed in (3, 4):
        assert np.allclose(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0], atol=1e-6)
        for action in np.random.default_rng(0).uniform(-1, 1, (30, 6)):
            found, expected = ours.step(action), theirs.step(action)
            assert np.allclose(found[0], expected[0], atol=1e-4) and found[1] == pytest.approx(expected[1], abs=1e-4)
            assert found[2:4] == expected[2:4]


def test_its_policy_sees_no_context_and_its_file_keeps_the_run(bank, tmp_path):
    assert bank.policies[0].weights.shape == (6, 17) and bank.sizes(0) == (17, 6) and len(bank.run) == 25
    record = bank.card["policies"][0]
    assert [iteration for iteration, _ in record["run"]] == [5, 10, 15, 20, 25]
    assert max(record["run"], key=lambda one: one[1]) == (record["iteration"], record["judged"])
    best = bank.run[record["iteration"] - 1]
    assert np.array_equal(best.weights, bank.policies[0].weights)
    save_expert(bank, tmp_path / "a.npz")
    read = load_expert(tmp_path / "a.npz")
    assert all(np.array_equal(one.mean, other.mean) for one, other in zip(bank.run, read.run, strict=True))
    assert ExpertRecipe.from_json(read.card["recipe"]) == RECIPE
    other = PolicyBank([best], None, {})
    save_expert(other, tmp_path / "b.npz")
    assert load_expert(tmp_path / "b.npz").run is None


def test_medium_is_nearest_to_a_third_of_the_best_and_before_it(bank):
    told = dict(bank.card, policies=[bank.card["policies"][0] | {"run": [(5, 90.0), (10, 30.0), (15, 41.0), (20, 100.0), (25, 33.0)]}])
    told["policies"][0] |= {"iteration": 20, "judged": 100.0}
    flown, card = flights(replace(bank, card=told), RECIPE, "medium", 3, seed=0)
    assert card == {"name": "medium", "medium": {"iteration": 10, "judged": 30.0}} and len(flown) == 3
    assert all(np.array_equal(flight.expert.policies[0].weights, bank.run[9].weights) for flight in flown)
    both, card = flights(replace(bank, card=told), RECIPE, "medium-expert", 5, seed=0)
    assert [flight.expert.policies[0] is bank.policies[0] for flight in both] == [False] * 3 + [True] * 2
    assert card["expert"] == {"iteration": 20, "judged": 100.0}


def test_the_replay_is_what_the_run_tried_step_by_step(bank):
    """Flown again from the file alone, each episode is the one that the search learned from, but for actions of 32 bits."""
    told = dict(bank.card, policies=[bank.card["policies"][0] | {"run": [(15, 10.0), (25, 31.0)], "iteration": 25, "judged": 31.0}])
    flown, card = flights(replace(bank, card=told), RECIPE, "medium-replay", 10_000, seed=0)
    assert len(flown) == card["episodes_of_the_run"] == 15 * 8, "all of it, where more is asked for"
    some, _ = flights(replace(bank, card=told), RECIPE, "medium-replay", 6, seed=0)
    again, _ = flights(replace(bank, card=told), RECIPE, "medium-replay", 6, seed=1)
    seeds = [flight.seed for flight in flown]
    places = [seeds.index(flight.seed) for flight in some]
    assert places == sorted(places) and [flight.seed for flight in some] != [flight.seed for flight in again]
    course = _Course(RECIPE, 0)
    for place in (0, 1, 2 * 8 + 3, 14 * 8 + 7):
        _, visited = course.practise(flown[place].expert.policies[0], flown[place].seed)
        episodes, _ = collect(Job("walker2d", {}, 1, (0.0,), seed=9), bank, flights=[flown[place]])
        assert np.array_equal(episodes.observations[0], visited[0].astype(np.float32)) and len(visited) > 10
        assert np.allclose(episodes.observations[:12], visited[:12], atol=1e-3) and abs(len(episodes.rewards) - len(visited)) <= 2
    # The run itself: what its first iterations visited is what the policies after them reckon with.
    states = [course.practise(flight.expert.policies[0], flight.seed)[1] for flight in flown[:24]]
    for iterations in (1, 2, 3):
        assert np.allclose(np.concatenate(states[: 8 * iterations]).mean(axis=0), bank.run[iterations - 1].mean, atol=1e-9)


def test_the_command_makes_the_three_of_one_run(bank, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(bank.card["policies"][0], "iteration", 25)
    save_expert(bank, tmp_path / "run.npz")
    cards = {}
    for quality in ("medium", "medium-replay", "medium-expert"):
        path = tmp_path / f"{quality}.h5"
        words = ["--env", "walker2d", "--quality", quality, "--expert", str(tmp_path / "run.npz"), "--episodes", "4"]
        assert collect_command([*words, "--quiet", "--out", str(path)]) == 0
        cards[quality] = json.loads(path.with_suffix(".card.json").read_text())
        assert cards[quality]["quality"]["name"] == quality and cards[quality]["episodes"] == 4 and "score" in cards[quality]["measures"]
    assert cards["medium-replay"]["action_noise"] == [0.0] != cards["medium"]["action_noise"]
    assert len({card["quality"]["medium"]["iteration"] for card in cards.values()}) == 1
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--env", "walker2d", "--quality", "best"], "must be one of medium, medium-replay, medium-expert"),
        (["--env", "walker2d", "--quality", "medium", "--play", "0.5"], "takes neither"),
        (["--env", "point-wind-s", "--quality", "medium"], "searched for"),
        (["--env", "walker2d", "--quality", "medium", "--expert", "other.npz"], "expert with its run"),
        (["--env", "walker2d", "--play", "0.5", "--expert", "random"], "no hidden context"),
    ],
)
def test_what_cannot_be_is_said_in_a_line(tmp_path, monkeypatch, capsys, words, part):
    monkeypatch.chdir(tmp_path)
    save_expert(
        PolicyBank([LinearPolicy(np.zeros((6, 17)), np.zeros(17), np.ones(17))], None, {"recipe": RECIPE.to_json()}), tmp_path / "other.npz"
    )
    assert collect_command([*words, "--quiet", "--episodes", "2", "--out", "a.h5"]) == 2
    error = capsys.readouterr().err
    assert part in error and error.count("\n") == 1 and not (tmp_path / "a.h5").exists()


def test_an_expert_of_a_context_does_not_fly_where_there_is_none(bank):
    job = Job("walker2d", {}, 1, (0.0,), seed=0)
    two = PolicyBank([bank.policies[0]] * 2, np.array([1.0, 2.0]), {})
    with pytest.raises(ValueError, match="tells none"):
        collect(job, two)
    reading = PolicyBank([LinearPolicy(np.zeros((6, 18)), np.zeros(18), np.ones(18))], None, {})
    with pytest.raises(ValueError, match="made for observations and actions of"):
        collect(job, reading)
    episodes, failed = collect(job, bank)
    assert "quality" not in data_card(job, bank, episodes, failed)
