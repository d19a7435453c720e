"""The pendulum under a torque that nobody sees is Gymnasium's but for that, and it pays to know it."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest

from ada_diffuser import environments
from ada_diffuser.environments import PendulumTorqueS


def test_without_the_torque_it_is_gymnasiums_pendulum():
    theirs, ours = gym.make("Pendulum-v1").unwrapped, PendulumTorqueS(swing=0.0)
    assert np.array_equal(theirs.reset(seed=3)[0], ours.reset(seed=3)[0])
    for action in np.random.default_rng(0).uniform(-3, 3, (50, 1)):
        expected, found = theirs.step(action), ours.step(action)
        assert np.allclose(expected[0], found[0], atol=1e-6) and expected[1] == pytest.approx(found[1], abs=1e-9)


def test_it_follows_its_equations():
    env = PendulumTorqueS(swing=1.2, rate=0.5, phase=0.3)
    env.reset(seed=1)
    env.state = np.array([0.5, -1.0])
    _, reward, *_, info = env.step(np.array([5.0], np.float32))
    torque = 1.2 * math.sin(0.3)
    speed = -1.0 + 0.05 * (15 * math.sin(0.5) + 3 * (2.0 + torque))
    assert env.state == pytest.approx([0.5 + 0.05 * speed, speed], abs=1e-6)
    assert reward == pytest.approx(-(0.5**2) - 0.1 - 0.001 * 2.0**2)
    assert info["context"] == pytest.approx([torque], abs=1e-6) and env.context == pytest.approx([1.2 * math.sin(0.8)], abs=1e-6)


def test_the_phase_is_drawn_once_an_episode():
    env = environments.make("pendulum-torque-s")
    first = [float(env.reset(seed=0 if i == 0 else None)[1]["context"][0]) for i in range(100)]
    assert len(set(first)) == 100 and max(abs(value) for value in first) <= 1.3


@pytest.mark.parametrize("swing", [-0.1, 1.6, math.nan])
def test_a_torque_that_cannot_be_held_is_refused(swing):
    with pytest.raises(ValueError, match="swing"):
        environments.make("pendulum-torque-s", swing=swing)


def flown(told, episodes=64):
    """Return of each episode, and whether it ended upright."""
    env = environments.make("pendulum-torque-s")
    returns, upright = np.zeros(episodes), np.ones(episodes, bool)
    for episode in range(episodes):
        observation, _ = env.reset(seed=1000 + episode)
        for step in range(200):
            task = env.unwrapped
            observation, reward, *_ = env.step(task.expert_action(observation, told(task)))
            returns[episode] += reward
            upright[episode] &= step < 150 or observation[0] > 0.95
    return returns, upright


def test_who_knows_the_torque_holds_the_rod_and_who_does_not_never_does():
    """The figures of the class's docstring."""
    told, held = flown(lambda task: task.context)
    blind, held_blind = flown(lambda task: np.zeros(1))
    assert told.mean() == pytest.approx(-184, abs=3) and held.all()
    assert blind.mean() == pytest.approx(-734, abs=15) and not held_blind.any()
    assert not any(PendulumTorqueS().failed(value) for value in told)
