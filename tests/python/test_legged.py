"""Gymnasium's hopper and walker, but for a number of their physics that an episode draws and nobody is told."""

from __future__ import annotations

import json
import math

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from ada_diffuser import environments
from ada_diffuser.collect import Job, collect
from ada_diffuser.environments import ArsSettings, HopperGravityE, WalkerMassE
from ada_diffuser.experts import ExpertRecipe, make_expert, random_expert
from ada_diffuser.experts.policy import LinearPolicy
from ada_diffuser.experts.training import _Course

OURS = {"hopper-gravity-e": ("gravity", 9.81, "Hopper-v5"), "walker-mass-e": ("mass", 1.0, "Walker2d-v5")}


@pytest.mark.parametrize("name", OURS)
def test_at_gymnasiums_own_number_it_is_gymnasiums(name):
    option, value, theirs = OURS[name]
    ours, theirs = environments.make(name, **{option: (value, value)}).unwrapped, gym.make(theirs).unwrapped
    for seed in (3, 4):
        assert np.allclose(ours.reset(seed=seed)[0], theirs.reset(seed=seed)[0], atol=1e-6)
        for action in np.random.default_rng(0).uniform(-1, 1, (15, *theirs.action_space.shape)):
            found, expected = ours.step(action), theirs.step(action)
            assert np.allclose(found[0], expected[0], atol=1e-4) and found[1] == pytest.approx(expected[1], abs=1e-4)
            assert found[2:4] == expected[2:4]


@pytest.mark.parametrize("name", OURS)
def test_the_number_is_drawn_once_an_episode_from_its_range(name):
    env = environments.make(name)
    drawn = []
    for episode in range(60):
        told = env.reset(seed=0 if episode == 0 else None)[1]["context"]
        assert {env.step(np.zeros(env.action_space.shape, np.float32))[4]["context"][0] for _ in range(3)} == {told[0]}
        drawn.append(told[0])
    least, largest = getattr(env.unwrapped, OURS[name][0])
    assert len(set(drawn)) == 60 and least <= min(drawn) < least + 0.1 * (largest - least)
    assert largest - 0.1 * (largest - least) < max(drawn) <= largest


@pytest.mark.parametrize("gravity", [6.0, 14.0])
def test_what_falls_freely_falls_by_the_gravity_told(gravity):
    env = HopperGravityE(gravity=(gravity, gravity))
    env.reset(seed=0)
    env.set_state(env.init_qpos + np.array([0, 5.0, 0, 0, 0, 0]), np.zeros(6))
    for _ in range(10):
        env.step(np.zeros(3))
    t = 10 * env.dt
    assert env.dt == pytest.approx(0.008)
    assert env.data.subtree_com[1][2] == pytest.approx(_rest_height(env) + 5.0 - gravity * t**2 / 2, abs=2e-3)
    assert env.data.qvel[1] == pytest.approx(-gravity * t, rel=0.02)


def _rest_height(env):
    data = mujoco.MjData(env.model)
    data.qpos[:] = env.init_qpos
    mujoco.mj_forward(env.model, data)
    return data.subtree_com[1][2]


def test_the_walkers_torso_has_the_mass_told_and_the_rest_its_own():
    env, own = WalkerMassE(mass=(2.0, 2.0)), gym.make("Walker2d-v5").unwrapped.model
    for _ in range(3):  # an episode starts from Walker2d-v5, not from the last one
        env.reset(seed=0)
        torso = env.model.body("torso").id
        assert env.model.body_mass[torso] == pytest.approx(2 * own.body_mass[torso])
        assert np.allclose(env.model.body_inertia[torso], 2 * own.body_inertia[torso])
        rest = np.arange(own.nbody) != torso
        assert np.array_equal(env.model.body_mass[rest], own.body_mass[rest])
        assert env.model.body_subtreemass[torso] == pytest.approx(own.body_subtreemass[torso] + own.body_mass[torso])


@pytest.mark.parametrize("name", OURS)
def test_nothing_is_left_of_the_episode_before(name):
    def rows(before):
        env = environments.make(name).unwrapped
        for seed in before:
            env.reset(seed=seed)
            env.step(np.ones(env.action_space.shape))
        seen = [env.reset(seed=7)[0]]
        return np.array(seen + [env.step(np.full(env.action_space.shape, 0.3))[0] for _ in range(20)])

    assert np.array_equal(rows(()), rows((1, 2)))


@pytest.mark.parametrize("name", OURS)
def test_actions_beyond_the_bounds_are_those_at_the_bounds(name):
    def step(size):
        env = environments.make(name).unwrapped
        env.reset(seed=7)
        observation, reward, *_ = env.step(np.full(env.action_space.shape, size))
        return [*observation, reward]

    assert step(5.0) == step(1.0)


@pytest.mark.parametrize("name", OURS)
@pytest.mark.parametrize("span", [(14, 6), (0, 1), (9,), (1, math.inf), (math.nan, 2)])
def test_a_range_that_is_none_is_refused(name, span):
    option = OURS[name][0]
    with pytest.raises(ValueError, match=f"{option} must be two numbers"):
        environments.make(name, **{option: span})


@pytest.mark.parametrize("name", OURS)
def test_a_fall_ends_the_episode_and_the_data_say_so(name):
    env = environments.make(name)
    job = Job(name, {}, 6, (0.0,), seed=1)
    episodes, failed = collect(job, random_expert(env.action_space.low, env.action_space.high, 0))
    ends = np.flatnonzero(episodes.terminals)
    assert len(ends) == 6 and not episodes.timeouts.any() and ends[-1] == len(episodes.rewards) - 1
    lengths = np.diff(ends, prepend=-1)
    assert (lengths < 400).all() and len(set(lengths)) > 1
    assert len(episodes.returns()) == 6 and failed.all()
    assert len(set(episodes.context[ends, 0].tolist())) == 6


def test_practice_and_judging_stop_at_the_fall_and_only_judging_pays_for_standing():
    course = _Course(ExpertRecipe("ada/HopperGravity-E-v0", {}, 0), slot=0)
    policy = LinearPolicy(np.zeros(course.shape), np.zeros(12), np.ones(12))
    practised, visited = course.practise(policy, 5)
    judged, failures = course.judge(policy, np.array([5]), (0.0,))
    assert 10 < len(visited) < 400 and failures == 1
    # healthy in every step but the last
    assert judged[0] - practised == pytest.approx(len(visited) - 1, abs=1e-6)


def test_a_blind_policy_has_no_input_for_the_context_and_its_file_says_it_is_blind(tmp_path):
    recipe = ExpertRecipe("ada/HopperGravity-E-v0", {}, 0, seeds=1, ars=ArsSettings(iterations=1, directions=1, top=1), blind=True)
    bank = make_expert(recipe)
    assert bank.policies[0].weights.shape == (3, 11) and bank.sizes(1) == (11, 3)
    actions = [bank.act(np.ones(11), np.array([gravity])) for gravity in (6.0, 14.0)]
    assert np.array_equal(*actions) and bank.card["recipe"]["blind"] is True
    json.dumps(bank.card)
