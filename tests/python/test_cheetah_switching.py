"""A wish of step t is paid for later: `delay` steps later, or in `horizon` steps."""

from __future__ import annotations

import numpy as np
import pytest

from ada_diffuser import environments

NAMES = {"cheetah-delayed-s": "delay", "cheetah-cumulative-s": "horizon"}


def flown(name, steps=120, seed=2, **options):
    """Wishes, speeds and rewards of an episode of random actions, each (steps,)."""
    env = environments.make(name, **options)
    env.reset(seed=seed)
    rng = np.random.default_rng(0)
    rows = [env.step(rng.uniform(-1, 1, 6).astype(np.float32)) for _ in range(steps)]
    return np.array([[info["context"][0], info["x_velocity"], reward] for _, reward, _, _, info in rows], np.float64).T


@pytest.mark.parametrize("delay", [0, 1, 7])
def test_delayed_pays_for_the_wish_of_so_many_steps_ago(delay):
    """The paper's r_{t+l} = -||v_{t+l} - c_t||^2, and the first wish before there was one."""
    wishes, speeds, rewards = flown("cheetah-delayed-s", delay=delay, change=0.2)
    assert len(set(wishes.tolist())) == 2
    for t in range(len(wishes) - delay):
        assert rewards[t + delay] == pytest.approx(-((speeds[t + delay] - wishes[t]) ** 2), rel=1e-5, abs=1e-8)
    assert np.allclose(rewards[:delay], -((speeds[:delay] - wishes[0]) ** 2))


@pytest.mark.parametrize("horizon", [1, 2, 6])
def test_cumulative_pays_for_each_of_the_last_wishes(horizon):
    """The paper's r_{t+k} = -||v_{t+k} - c_t||^2 for k = 0..L-1, summed over the wishes that a step is paid for."""
    wishes, speeds, rewards = flown("cheetah-cumulative-s", horizon=horizon, change=0.2)
    expected = np.zeros(len(wishes))
    for t, wish in enumerate(wishes):
        for k in range(horizon):
            if t + k < len(wishes):
                expected[t + k] -= (speeds[t + k] - wish) ** 2
    for t in range(horizon - 1):  # the steps before the first wished what it did
        expected[t] -= (horizon - 1 - t) * (speeds[t] - wishes[0]) ** 2
    assert np.allclose(rewards, expected, rtol=1e-5)


def test_without_delay_and_over_one_step_they_are_the_same():
    assert np.array_equal(flown("cheetah-delayed-s", delay=0), flown("cheetah-cumulative-s", horizon=1))


@pytest.mark.parametrize("name", NAMES)
def test_wishes_change_as_often_as_they_should_and_are_among_the_targets(name):
    env = environments.make(name, targets=(0.5, 1.0, 2.0), change=0.1, episode_steps=2000)
    wishes = [env.reset(seed=0)[1]["context"][0]] + [env.step(np.zeros(6, np.float32))[4]["context"][0] for _ in range(2000)]
    assert set(wishes) == {0.5, 1.0, 2.0}
    assert np.mean(np.diff(wishes) != 0) == pytest.approx(0.1, abs=0.03)
    assert len(set(flown(name, change=0.0)[0])) == 1 and len(set(flown(name, targets=[1.5], change=1.0)[0])) == 1


def test_the_gale_told_is_the_force_on_the_torso_against_the_run():
    env = environments.make("cheetah-gale-s", change=0.3).unwrapped
    env.reset(seed=0)
    torso, told = env.body.model.body("torso").id, []
    for action in np.random.default_rng(0).uniform(-1, 1, (40, 6)):
        _, reward, *_, info = env.step(action)
        assert env.body.data.xfrc_applied[torso].tolist() == [-info["context"][0], 0, 0, 0, 0, 0]
        assert reward == pytest.approx(-abs(info["x_velocity"] - 1.5) - 0.05 * action @ action)
        told.append(info["context"][0])
    assert set(told) == {-40.0, 15.0}


@pytest.mark.parametrize("name", NAMES)
def test_standing_still_fails_and_half_the_error_does_not(name):
    env = environments.make(name).unwrapped
    env.reset(seed=0)
    wishes = np.array([env.step(np.zeros(6, np.float32))[4]["context"][0] for _ in range(200)])
    assert len(set(wishes)) == 2
    paid = np.ones(200) if name == "cheetah-delayed-s" else np.full(200, 5.0)
    still = -float((paid * wishes**2).sum())
    assert env.failed(still) and not env.failed(still / 2)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("cheetah-gale-s", {"winds": []}),
        ("cheetah-gale-s", {"winds": [float("inf"), 1.0]}),
        ("cheetah-gale-s", {"change": -0.1}),
        ("cheetah-delayed-s", {"delay": -1}),
        ("cheetah-delayed-s", {"delay": 1.5}),
        ("cheetah-delayed-s", {"targets": []}),
        ("cheetah-delayed-s", {"targets": "uniform"}),
        ("cheetah-delayed-s", {"change": 1.1}),
        ("cheetah-cumulative-s", {"horizon": 0}),
        ("cheetah-cumulative-s", {"horizon": True}),
        ("cheetah-cumulative-s", {"targets": [0.0, 1.0]}),
        ("cheetah-cumulative-s", {"change": float("nan")}),
    ],
)
def test_an_option_that_cannot_be_is_refused_by_its_name(name, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be"):
        environments.make(name, **options)
