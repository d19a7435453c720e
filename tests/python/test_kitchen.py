"""Kitchen: it is gymnasium-robotics' own, and its pilot does what it is to do."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from ada_diffuser import environments
from ada_diffuser.collect import Job, collect
from ada_diffuser.environments import KitchenMixed, KitchenPartial, kitchen_body
from ada_diffuser.environments.extra import robotics
from ada_diffuser.environments.kitchen import DONE, GOALS
from ada_diffuser.environments.kitchen_body import ROBOT, START, KitchenBody
from ada_diffuser.environments.kitchen_pilot import SCRIPTS, Pilot
from ada_diffuser.experts import PlannedExpert, formula_of


@pytest.fixture(scope="module")
def kitchen() -> KitchenPartial:
    return KitchenPartial()


def test_it_is_gymnasium_robotics_own_but_for_the_noise(monkeypatch):
    """Whose class reads the joints in a way that MuJoCo 4 does not have any more: here it is told another."""
    theirs = robotics("envs.franka_kitchen.kitchen_env")
    monkeypatch.setattr(
        robotics("envs.franka_kitchen.franka_env"), "robot_get_obs", lambda model, data, names: (data.qpos[:9].copy(), data.qvel[:9].copy())
    )
    wanted = ["microwave", "kettle", "light switch", "slide cabinet", "bottom burner"]
    env = theirs.KitchenEnv(tasks_to_complete=wanted, robot_noise_ratio=0.0, object_noise_ratio=0.0)
    assert np.allclose(env.robot_env.init_qpos, START, atol=7e-3), "all but what is ajar by less than half a degree"
    env.robot_env.init_qpos = START
    monkeypatch.setattr(kitchen_body, "ROBOT_NOISE", 0.0)
    monkeypatch.setattr(kitchen_body, "OBJECT_NOISE", 0.0)
    body, rng = KitchenBody(), np.random.default_rng(0)
    seen = [env.reset(seed=0)[0]["observation"], body.reset(rng)]
    assert np.allclose(*seen, atol=1e-9) and len(seen[1]) == 59
    for action in np.random.default_rng(1).uniform(-1.3, 1.3, (8, 9)):
        assert np.allclose(env.step(action)[0]["observation"], body.step(action, rng), atol=1e-7)
    for subtask in wanted:
        places = np.array(list(GOALS[subtask]))
        assert np.array_equal(places, theirs.OBS_ELEMENT_INDICES[subtask])
        assert np.array_equal(list(GOALS[subtask].values()), theirs.OBS_ELEMENT_GOALS[subtask])
    assert theirs.BONUS_THRESH == DONE


@pytest.mark.parametrize("subtask", SCRIPTS)
def test_each_script_does_its_subtask(kitchen, subtask, monkeypatch):
    monkeypatch.setattr(kitchen, "subtasks", (subtask,))
    observation, _ = kitchen.reset(seed=3)
    pilot = Pilot(kitchen.body.model, [subtask], kitchen.distance)
    for _ in range(70):
        action = pilot.act(observation)
        assert action.shape == (9,) and np.abs(action).max() <= 1.0
        observation, reward, ended, _, info = kitchen.step(action.astype(np.float32))
        assert reward == ended == (info["done"] == [subtask]) == (kitchen.distance(subtask, observation) < DONE)
        if ended:
            break
    assert ended


def test_a_subtask_counts_once_and_the_episode_ends_with_the_last(kitchen):
    kitchen.reset(seed=0)
    assert not kitchen.done
    earned = []
    for done in range(len(kitchen.subtasks)):
        goal = GOALS[kitchen.subtasks[done]]
        kitchen.body.data.qpos[list(goal)] = list(goal.values())
        _, reward, ended, *_ = kitchen.step(np.zeros(9, np.float32))
        earned.append(reward)
        assert ended == (sum(earned) == 4) and kitchen.done[-1] == kitchen.subtasks[done]
    assert sum(earned) == 4 and environments.measures(kitchen, 3.0) == {"score": 75.0, "subtasks": 3.0}
    assert kitchen.failed(0.0) and not kitchen.failed(1.0)


def test_the_goal_is_of_the_columns_that_it_says(kitchen):
    observation, _ = kitchen.reset(seed=0)
    assert len(kitchen.goal) == len(kitchen.goal_columns) == 1 + 7 + 2 + 1
    assert kitchen.goal_columns[0] == 31 and observation[31] == pytest.approx(kitchen.body.data.qpos[22], abs=1e-4), "the microwave's door"
    reached = np.linalg.norm(observation[list(kitchen.goal_columns)][1:8] - kitchen.goal[1:8])
    assert reached == pytest.approx(kitchen.distance("kettle", observation), abs=1e-5)
    assert KitchenMixed.goal_columns != KitchenPartial.goal_columns and ROBOT == 9


def test_partial_shows_all_in_some_demonstrations_and_mixed_in_none(kitchen):
    for cls, least, most in ((KitchenPartial, 0.1, 0.3), (KitchenMixed, 0.0, 0.0)):
        rng, orders = np.random.default_rng(0), []
        for _ in range(200):
            orders.append(cls.drawn_order(cls.__new__(cls), rng))
        share = np.mean([set(order) == set(cls.subtasks) for order in orders])
        assert least <= share <= most and len({tuple(order) for order in orders}) > 60
        assert {len(set(order)) for order in orders} == {4} and len(Counter(order[0] for order in orders)) == 5


def test_a_demonstration_does_what_was_drawn():
    """One with the noise of the data; docs and README say how often each subtask is done."""
    env = environments.make("kitchen-mixed")
    expert = formula_of(env)
    assert isinstance(expert, PlannedExpert) and expert.card["law"].startswith("four of the five subtasks")
    episodes, failed = collect(Job("kitchen-mixed", {}, 1, (0.05,), seed=2), expert)
    assert episodes.returns() == [3.0] and not failed.any() and len(episodes.rewards) == 280
    assert episodes.goal.shape == (280, 12) and np.array_equal(episodes.goal[0], env.unwrapped.goal)
    with pytest.raises(ValueError, match="none that is blind"):
        formula_of(env, blind=True)
