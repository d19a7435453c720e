"""A direction that turns within the episode is paid for as the paper has it, and the experts turn with it."""

from __future__ import annotations

import json
import math

import gymnasium as gym
import numpy as np
import pytest

from ada_diffuser import environments
from ada_diffuser.commands.collect import main as collect
from ada_diffuser.dataset import load_episodes
from ada_diffuser.environments import AntDirE, ArsSettings, CheetahDirE
from ada_diffuser.environments.ant import AntBody
from ada_diffuser.experts import ExpertRecipe, formula_of, recipe_for
from ada_diffuser.experts.ars import search
from ada_diffuser.experts.training import _Course

NAMES = ("cheetah-dir-e", "ant-dir-e")


def sigmoid(steps, phase=0.0):
    return 1 / (1 + np.exp(-5 * np.sin(2 * math.pi * np.arange(steps) / 200 + phase)))


def flown(name, steps=200, seed=2, **options):
    """Directions, speeds, rewards and efforts a.a of an episode of random actions, each (steps,)."""
    env = environments.make(name, **options)
    env.reset(seed=seed)
    rng, rows = np.random.default_rng(0), []
    for _ in range(steps):
        action = rng.uniform(-1.5, 1.5, env.action_space.shape).astype(np.float32)
        before = env.unwrapped.body.x
        _, reward, _, _, info = env.step(action)
        clipped = np.clip(action, -1, 1).astype(float)
        assert info["x_velocity"] == pytest.approx((info["x_position"] - before) / 0.05)
        rows.append([info["context"][0], info["x_velocity"], reward, clipped @ clipped])
    return np.array(rows, np.float64).T


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("directions", "slope", "offset"), [("signed", 2, -1), ("unsigned", 1, 0)])
def test_at_phase_0_the_direction_is_the_papers_and_pays_for_the_speed_along_it(name, directions, slope, offset):
    """Ant-Dir's 2 sigmoid(5 sin(2 pi t / 200)) - 1, for the cheetah too, or the sigmoid alone as Cheetah-Dir's is printed."""
    told, speeds, rewards, efforts = flown(name, phase=0.0, directions=directions)
    expected = slope * sigmoid(200) + offset
    assert np.allclose(told, expected, atol=1e-6)
    assert np.allclose(rewards, expected * speeds - 0.1 * efforts, atol=1e-6)
    assert expected.min() == pytest.approx(-0.98661 if directions == "signed" else 0.00669, abs=1e-5), "one of them never turns round"


@pytest.mark.parametrize("name", NAMES)
def test_each_episode_draws_a_phase_unless_one_is_given(name):
    env = environments.make(name)
    rows = np.column_stack([np.sin(2 * math.pi * np.arange(40) / 200), np.cos(2 * math.pi * np.arange(40) / 200)])
    phases = []
    for episode in range(4):
        env.reset(seed=0 if episode == 0 else None)
        told = [env.step(np.zeros(env.action_space.shape, np.float32))[4]["context"][0] for _ in range(40)]
        (cosine, sine), *_ = np.linalg.lstsq(rows, np.arctanh(np.array(told, np.float64)) / 2.5, rcond=None)
        phases.append(math.atan2(sine, cosine))
        assert np.allclose(told, 2 * sigmoid(40, phases[-1]) - 1, atol=1e-4)
    assert np.diff(sorted(phases)).min() > 0.01
    for seed in (1, 2):
        assert np.allclose(flown(name, 40, seed, phase=2.0)[0], 2 * sigmoid(40, 2.0) - 1, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("cheetah-dir-e", {"directions": "both"}),
        ("ant-dir-e", {"directions": "both"}),
        ("cheetah-dir-e", {"drills": (0.0, 1.0)}),
        ("cheetah-dir-e", {"drills": (math.nan,)}),
        ("cheetah-dir-e", {"drills": "forward"}),
    ],
)
def test_an_option_that_cannot_be_is_refused_by_its_name(name, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be"):
        environments.make(name, **options)


# ---- the cheetah ----


def test_a_drill_holds_its_direction_and_throws_the_cheetah_the_wrong_way_twice():
    thrown = []
    for seed in range(6):
        for target in (-1.0, 1.0):
            env = CheetahDirE(drills=(target,))
            env.reset(seed=seed)
            steps = [env.step(np.zeros(6))[4] for _ in range(120)]
            assert {step["context"][0] for step in steps} == {target}
            speeds = target * np.array([step["x_velocity"] for step in steps])
            assert np.abs(speeds[90:100]).max() < 0.2, "limp, it lies still"
            thrown += [speeds[0], speeds[100]]
    assert -5.5 < min(thrown) < -3.5 and -1.5 < max(thrown) < 0.2
    assert len({CheetahDirE(drills=(-1.0, 1.0)).reset(seed=seed)[1]["context"][0] for seed in range(9)}) == 2


def test_there_is_a_gait_for_each_direction_that_is_asked_for():
    assert CheetahDirE().search_targets == (-1.0, 1.0) and CheetahDirE(directions="unsigned").search_targets == (1.0,)
    recipe = recipe_for(environments.make("cheetah-dir-e"), {}, 0)
    assert recipe.targets == (-1.0, 1.0) and recipe_for(environments.make("cheetah-dir-e"), {}, 0, blind=True).targets == ()
    for slot, target in enumerate(recipe.targets):
        assert _Course(recipe, slot).env.drills == (target,)


def test_a_short_search_finds_a_way_to_run_backward():
    course = _Course(ExpertRecipe("ada/CheetahDir-E-v0", {}, 0, targets=(-1.0,)), slot=0)
    settings = ArsSettings(iterations=16, directions=6, top=3)
    *_, policy = search(course.practise, course.shape, settings, np.random.default_rng(0))
    returns, _ = course.judge(policy, np.arange(6), (0.0,))
    assert returns.mean() > 50, "what is drawn at random earns less than nothing"


# ---- the ant ----


def test_the_ants_body_is_gymnasiums_without_contact_forces():
    body, env = AntBody(), gym.make("Ant-v5", include_cfrc_ext_in_observation=False).unwrapped
    theirs = env.reset(seed=9)[0]
    body.reset(np.random.Generator(np.random.PCG64(np.random.SeedSequence(9))))
    assert body.observation().shape == (27,) and np.allclose(body.observation(), theirs, atol=1e-6)
    for action in np.random.default_rng(0).uniform(-1, 1, (10, 8)):
        before = env.data.qpos[0]
        theirs = env.step(action)[0]
        speed = body.step(action)
        assert np.allclose(body.observation(), theirs, atol=1e-5)
        assert speed == pytest.approx((env.data.qpos[0] - before) / env.dt, abs=1e-9) and body.dt == env.dt


def test_an_ant_on_its_back_goes_on_and_does_not_see_where_it_is():
    env = AntDirE(phase=0.0)
    env.reset(seed=0)
    env.body.data.qpos[2:7] = 0.3, 0.0, 1.0, 0.0, 0.0
    seen = env.body.observation()
    env.body.data.qpos[:2] = 7.0, -3.0
    assert np.array_equal(env.body.observation(), seen)
    assert not any(env.step(np.zeros(8))[2] for _ in range(20)) and env.observation_space.contains(env.body.observation())


def test_the_ants_law_is_the_same_from_wherever_it_looks():
    """Only the way that is wanted, as its torso sees it, may count: turned half round and wanted the other way it does the same."""
    env, rng = AntDirE(), np.random.default_rng(0)
    for yaw in (0.4, math.pi / 2, math.pi):
        observation = rng.normal(size=27).astype(np.float32) * 0.3
        looks = [np.array(observation), np.array(observation)]
        for seen, angle in zip(looks, (yaw, yaw + math.pi), strict=True):
            seen[1:5] = math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)
        there, back = env.expert_action(looks[0], np.array([0.9])), env.expert_action(looks[1], np.array([-0.9]))
        assert np.allclose(there, back, atol=1e-5) and not np.allclose(there, env.expert_action(looks[0], np.array([-0.9])), atol=0.05)


def episode_of_the_expert(seed, told=None):
    """Its return, and how far it came while the direction was below 0 and above."""
    env = AntDirE()
    observation, _ = env.reset(seed=seed)
    total, came = 0.0, {False: 0.0, True: 0.0}
    for _ in range(200):
        action = env.expert_action(observation, env.context if told is None else told)
        observation, reward, _, _, info = env.step(action)
        total += reward
        came[bool(info["context"][0] > 0)] += 0.05 * info["x_velocity"]
    return total, came[False], came[True]


def test_the_ants_expert_goes_both_ways_and_who_is_told_no_direction_stands():
    returns, backward, forward = np.array([episode_of_the_expert(seed) for seed in range(5)]).T
    assert returns.mean() == pytest.approx(148, abs=45) and backward.max() < -1 and forward.min() > 1
    blind = formula_of(environments.make("ant-dir-e"), blind=True)
    assert blind.card["told"] == [0.0] and blind.card["law"].startswith("hip = ")
    assert abs(episode_of_the_expert(0, np.zeros(1))[0]) < 5


# ---- data ----


@pytest.mark.parametrize(("name", "kind"), [("cheetah-dir-e", "ars"), ("ant-dir-e", "analytic")])
def test_data_of_it_are_collected(name, kind, tmp_path, capsys):
    path = tmp_path / "x.h5"
    flags = ["--env-option", "phase=0", "--episodes", "2", "--quiet", "--expert-searches", "1", "--expert-iterations", "1"]
    assert collect(["--env", name, "--out", str(path), *flags]) == 0
    episodes, card = load_episodes(path), json.loads((tmp_path / "x.card.json").read_text())
    assert np.allclose(episodes.context[:, 0], np.tile(2 * sigmoid(200) - 1, 2), atol=1e-6)
    assert (card["expert"]["kind"], card["steps"], card["environment"]["options"]) == (kind, 400, {"phase": 0})
    assert episodes.observations.shape == (400, 27 if name == "ant-dir-e" else 17)
    capsys.readouterr()
