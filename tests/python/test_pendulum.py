"""The pendulum is Gymnasium's, its gravity is hidden, and it pays to know it."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from ada_diffuser import environments
from ada_diffuser.environments import PendulumGravityE
from ada_diffuser.rollout import Episode
from ada_diffuser.rollout.film import Panel, save_film


def test_it_follows_its_equations():
    env = PendulumGravityE(gravity=(9.0, 9.0))
    env.reset(seed=1)
    env.state = np.array([0.5, -1.0])
    observation, reward, *_, info = env.step(np.array([1.5], np.float32))
    speed = -1.0 + 0.05 * (1.5 * 9.0 * math.sin(0.5) + 3 * 1.5)
    angle = 0.5 + 0.05 * speed
    assert np.allclose(observation, [math.cos(angle), math.sin(angle), speed], atol=1e-6)
    assert speed == pytest.approx(-0.4513878) and angle == pytest.approx(0.4774306), "by hand"
    assert reward == pytest.approx(-(0.5**2) - 0.1 - 0.001 * 1.5**2)
    assert type(reward) is float and info["context"].tolist() == [9.0]


def test_torque_and_speed_have_limits_and_the_angle_is_taken_round():
    env = PendulumGravityE()
    env.reset(seed=1)
    env.state = np.array([2 * math.pi + 0.3, 7.9])
    _, reward, *_ = env.step(np.array([50.0], np.float32))
    assert env.state[1] == 8.0
    assert reward == pytest.approx(-(0.3**2) - 0.1 * 7.9**2 - 0.001 * 2.0**2)


def test_at_a_known_gravity_it_is_gymnasiums_pendulum():
    theirs, ours = gym.make("Pendulum-v1", g=5.0).unwrapped, PendulumGravityE(gravity=(5.0, 5.0))
    assert np.array_equal(theirs.reset(seed=3)[0], ours.reset(seed=3)[0])
    for action in np.random.default_rng(0).uniform(-3, 3, (50, 1)):
        expected, found = theirs.step(action), ours.step(action)
        assert np.array_equal(expected[0], found[0]) and expected[1] == found[1]


def test_gravity_is_drawn_once_an_episode_from_its_range():
    env = environments.make("pendulum-gravity-e")
    drawn = []
    for episode in range(200):
        told = env.reset(seed=0 if episode == 0 else None)[1]["context"]
        assert told == [env.unwrapped.g], "what acts is what is told, to the last bit"
        assert {env.step(np.zeros(1, np.float32))[4]["context"][0] for _ in range(3)} == {told[0]}
        drawn.append(told[0])
    assert len(set(drawn)) == 200 and 4 <= min(drawn) < 4.5 and 15.5 < max(drawn) <= 16


@pytest.mark.parametrize("gravity", [(14, 6), (0, 1), (9,), (1, math.inf)])
def test_a_range_that_is_none_is_refused(gravity):
    with pytest.raises(ValueError, match="gravity"):
        environments.make("pendulum-gravity-e", gravity=gravity)


def flown(act, episodes=64, seed=1000):
    """Return of each episode, and whether it ended upright."""
    env = environments.make("pendulum-gravity-e")
    returns, upright = np.zeros(episodes), np.ones(episodes, bool)
    for episode in range(episodes):
        observation, _ = env.reset(seed=seed + episode)
        for step in range(200):
            observation, reward, *_ = env.step(act(env.unwrapped, observation))
            returns[episode] += reward
            upright[episode] &= step < 150 or observation[0] > 0.95
    return returns, upright


def test_the_pilot_that_is_told_the_gravity_balances_always_and_the_one_that_takes_it_for_10_does_not():
    """The figures of the class's docstring; and a failed episode is one that was not balanced."""
    told, balanced = flown(lambda env, observation: env.expert_action(observation, env.context))
    assert told.mean() == pytest.approx(-162, abs=3) and balanced.all()
    blind, balanced_blind = flown(lambda env, observation: env.expert_action(observation, np.array([10.0])))
    assert blind.mean() == pytest.approx(-396, abs=15) and 45 <= balanced_blind.sum() <= 49
    env = PendulumGravityE()
    for returns, upright in ((told, balanced), (blind, balanced_blind)):
        assert [env.failed(value) for value in returns] == (~upright).tolist()


def test_the_pilot_holds_against_gravity_near_the_top_and_pumps_elsewhere():
    env = PendulumGravityE()

    def torque(theta, omega, gravity):
        return env.expert_action(np.array([math.cos(theta), math.sin(theta), omega]), np.array([gravity]))

    assert torque(0.1, 0.2, 8.0) == pytest.approx([-8.0 / 2 * math.sin(0.1) - 4 * 0.1 - 2 * 0.2])
    assert torque(math.pi, 0.5, 8.0) == [2.0] and torque(math.pi, -0.5, 8.0) == [-2.0]
    assert torque(2.0, 8.0, 4.0) == [-2.0], "too much energy to come to rest"


def test_it_draws_the_rod_the_gravity_and_the_torque():
    env = environments.make("pendulum-gravity-e", gravity=(10.0, 10.0), render_mode="rgb_array").unwrapped
    env.reset(seed=1)
    env.step(np.array([2.0], np.float32))
    rod, red, torque, white = (30, 90, 180), (200, 60, 40), (160, 190, 230), (255, 255, 255)
    env.state = np.array([math.pi / 2, 0.0])  # to the left: angles count against the clock
    frame = env.render()
    assert frame.shape == (360, 360, 3) and frame.dtype == np.uint8
    assert tuple(frame[180, 70]) == rod and tuple(frame[180, 290]) == white and tuple(frame[250, 180]) == red
    assert tuple(frame[344, 100]) == torque and tuple(frame[344, 260]) == white
    env.state = np.array([0.0, 0.0])
    assert tuple(env.render()[70, 180]) == rod, "0 is upright"
    assert PendulumGravityE().render() is None
    with pytest.raises(ValueError, match="rgb_array"):
        PendulumGravityE(render_mode="human")


def test_its_film_shows_every_step(tmp_path):
    actions = [np.full(1, 2.0, np.float32)] * 10
    episode = Episode(3, actions=actions, rewards=[-1.0] * 10, contexts=[np.full(1, 9.0, np.float32)] * 10)
    assert save_film([Panel("pendulum-gravity-e", episode)], tmp_path / "film.gif") is None
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 10
