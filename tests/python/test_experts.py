"""The experts reach what they should, and the search that makes them is a function of its seed."""

from __future__ import annotations

import numpy as np
import pytest

from ada_diffuser import environments
from ada_diffuser.experts import ExpertRecipe, formula_of, load_expert, make_expert, recipe_for, save_expert
from ada_diffuser.experts.ars import ArsSettings, RunningMoments, ascent, search
from ada_diffuser.experts.policy import LinearPolicy, PolicyBank

TINY = ArsSettings(iterations=1, directions=2, top=1)


def point_wind_return(act, episodes=64):
    env = environments.PointWindS()
    observation, _ = env.reset(seed=0)
    total = 0.0
    for _ in range(episodes):
        for _ in range(200):
            observation, reward, *_ = env.step(act(observation, env.context))
            total += reward
        observation, _ = env.reset()
    return total / episodes


def test_the_pilot_that_sees_the_wind_earns_16_and_the_blind_one_135():
    pilot = formula_of(environments.PointWindS())
    assert point_wind_return(pilot.act) == pytest.approx(-16.2, abs=3)
    assert point_wind_return(lambda o, c: pilot.act(o, np.zeros(2))) == pytest.approx(-134.6, abs=15)


def test_search_climbs_a_bowl():
    goal = np.array([[0.3, -0.2], [0.1, 0.4]])

    def rollout(policy, seed):
        states = np.random.default_rng(seed).standard_normal((50, 2))
        effective = policy.weights / policy.std
        return -float(((effective - goal) ** 2).sum()), states

    policies = list(search(rollout, (2, 2), ArsSettings(iterations=150), np.random.default_rng(0)))
    assert rollout(policies[0], 0)[0] < -0.2 and rollout(policies[-1], 0)[0] > -0.01


def test_the_update_follows_the_best_directions_alone():
    deltas = np.array([[[1.0]], [[10.0]], [[100.0]]])
    returns = np.array([[5.0, 1.0], [0.0, 0.1], [2.0, 6.0]])
    best = [2, 0]
    settings = ArsSettings(top=2, step=0.5)
    expected = 0.5 / (2 * returns[best].std()) * (-4.0 * 100 + 4.0 * 1)
    assert ascent(deltas, returns, settings) == pytest.approx(expected)


def test_running_moments_equal_those_of_all_states():
    states = np.random.default_rng(0).normal(3, 2, (100, 4))
    moments = RunningMoments(4)
    for part in np.split(states, [10, 11, 60]):
        moments.add(part)
    assert np.allclose(moments.mean, states.mean(0)) and np.allclose(moments.std, states.std(0))


def test_a_search_is_a_function_of_its_recipe():
    recipe = ExpertRecipe("ada/CheetahVel-E-v0", {}, seed=0, seeds=1, targets=(1.0, 2.5), ars=TINY)
    first, second = make_expert(recipe), make_expert(recipe)
    assert first.card == second.card
    assert all(np.array_equal(a.weights, b.weights) for a, b in zip(first.policies, second.policies, strict=True))
    assert not np.array_equal(first.policies[0].weights, first.policies[1].weights)


def test_a_bank_flies_the_policy_nearest_to_the_context_and_survives_its_file(tmp_path):
    policies = [LinearPolicy(np.full((6, 17), float(i)), np.zeros(17), np.ones(17)) for i in range(2)]
    bank = PolicyBank(policies, np.array([1.0, 2.5]), {"kind": "ars"})
    save_expert(bank, tmp_path / "a.npz")
    save_expert(bank, tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    read = load_expert(tmp_path / "a.npz")
    assert read.card == bank.card
    for speed, value in ((0.0, 0.0), (1.2, 0.0), (2.0, 17.0)):
        assert np.array_equal(read.act(np.ones(17), np.array([speed])), np.full(6, value))


def test_a_single_policy_reads_the_context():
    policy = LinearPolicy(np.eye(6, 18, 12), np.zeros(18), np.ones(18))
    action = PolicyBank([policy], None, {}).act(np.zeros(17), np.array([4.0]))
    assert action.tolist() == [0, 0, 0, 0, 0, 4]


def test_a_file_that_is_no_expert_is_named(tmp_path):
    path = tmp_path / "no.npz"
    np.savez(path, other=np.zeros(3))
    with pytest.raises(ValueError, match=r"no\.npz"):
        load_expert(path)


def test_recipes_fit_their_environments():
    def recipe(name, *, blind=False, **options):
        return recipe_for(environments.make(name, **options), options, 0, 2, 1, blind=blind)

    assert recipe("point-wind-s") is None
    assert recipe("cheetah-wind-s", gain=2.0).targets == ()
    assert recipe("cheetah-vel-e").targets == (1.0, 2.5)
    assert len(recipe("cheetah-vel-e", targets="uniform").targets) == 5
    assert recipe("cheetah-gale-s").targets == (-40.0, 15.0)
    for name in ("cheetah-wind-s", "cheetah-vel-e"):
        blind, seeing = recipe(name, blind=True), recipe(name)
        assert (blind.targets, blind.blind, seeing.blind) == ((), True, False)
        assert blind.to_json()["blind"] is True and "blind" not in seeing.to_json(), "files of experts that see go on being theirs"


def test_a_blind_formula_is_told_the_mean_context_and_one_without_has_none():
    env = environments.make("pendulum-gravity-e", gravity=(5.0, 9.0))
    blind = formula_of(env, blind=True)
    observation = np.array([1.0, 0.1, 0.0])
    assert np.array_equal(blind.act(observation, np.array([5.0])), env.unwrapped.expert_action(observation, np.array([7.0])))
    assert blind.card["told"] == [7.0]
    env.unwrapped.__class__ = type("Untold", (environments.PendulumGravityE,), {"mean_context": None})
    with pytest.raises(ValueError, match="mean_context"):
        formula_of(env, blind=True)
