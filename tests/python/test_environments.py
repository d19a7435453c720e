"""The environments do what their definitions say, and hide what they say they hide."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ada_diffuser import environments
from ada_diffuser.commands.collect import main as collect
from ada_diffuser.dataset import load_episodes
from ada_diffuser.environments.half_cheetah import XML, HalfCheetahBody

CHEETAHS = [name for name in environments.NAMES if name.startswith("cheetah-wind") or name == "cheetah-vel-e"]
HIDDEN = environments.hidden()
FALLS = ("hopper-gravity-e", "walker-mass-e", "walker2d")
"""Environments whose episodes a fall ends."""
EARNED = dict.fromkeys(FALLS, 900.0) | {"cheetah-dir-e": 200.0, "ant-dir-e": 100.0}
"""What an expert may earn, where that is not below 0."""


@pytest.mark.parametrize("name", environments.NAMES)
def test_passes_gymnasiums_own_checker(name):
    with warnings.catch_warnings():
        warnings.filterwarnings("error")
        warnings.filterwarnings("ignore", message=".*(minimum|maximum) value is -?infinity.*")
        if name.startswith("pendulum"):  # a torque in N m, as in Gymnasium's own pendulum
            warnings.filterwarnings("ignore", message=".*symmetric and normalized space.*")
        check_env(environments.make(name).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("name", sorted(set(HIDDEN) - set(FALLS)))
def test_truncates_after_200_steps_and_never_terminates(name):
    env = environments.make(name)
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(200)]
    assert ends[:-1] == [(False, False)] * 199 and ends[-1] == (False, True)


@pytest.mark.parametrize("name", sorted(set(environments.NAMES) - set(HIDDEN)))
def test_what_hides_nothing_tells_no_context(name):
    env = environments.make(name)
    observation, info = env.reset(seed=3)
    assert observation.dtype == np.float32 and env.observation_space.contains(observation)
    assert "context" not in info and not hasattr(env.unwrapped, "context") and not hasattr(env.unwrapped, "coming_context")


@pytest.mark.parametrize("name", HIDDEN)
def test_observations_are_float32_and_do_not_hold_the_context(name):
    env = environments.make(name)
    observation, info = env.reset(seed=3)
    assert observation.dtype == np.float32 and env.observation_space.contains(observation)
    assert info["context"].dtype == np.float32 and info["context"].ndim == 1
    assert not np.isin(info["context"], observation).any()


@pytest.mark.parametrize("name", environments.NAMES)
def test_same_seed_same_episode(name):
    def episode(seed):
        env = environments.make(name)
        rows = [env.reset(seed=seed)[0]]
        rng = np.random.default_rng(1)
        for _ in range(20):
            observation, reward, _, _, info = env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
            rows.append(np.concatenate([observation, [reward], info.get("context", [])]))
        return np.concatenate(rows)

    assert np.array_equal(episode(5), episode(5))
    assert not np.array_equal(episode(5), episode(6))


@pytest.mark.parametrize("name", HIDDEN)
def test_a_steps_info_holds_the_context_that_acted_in_it(name):
    env = environments.make(name).unwrapped
    _, info = env.reset(seed=2)
    announced = info["context"]
    for _ in range(5):
        assert np.array_equal(announced, env.context)
        info = env.step(np.zeros(env.action_space.shape, np.float32))[4]
        assert np.array_equal(info["context"], announced)
        announced = env.context


def test_unknown_names_and_options_are_refused_with_the_choices():
    with pytest.raises(ValueError, match="point-wind-s"):
        environments.make("cheetah-rain")
    with pytest.raises(ValueError, match="rootx"):
        environments.make("cheetah-wind-s", wind_on="tail")
    with pytest.raises(ValueError, match="lilac"):
        environments.make("cheetah-vel-e", targets="fast")


def test_gymnasiums_own_way_finds_them_without_an_import(tmp_path):
    """The README's `gymnasium.make("ada/CheetahWind-S-v0")` failed for want of an import. Gymnasium reads no entry points of
    packages any more (since 1.0), so the example names the module, and this runs it where nothing else was imported."""
    code = 'import gymnasium; print(gymnasium.make("ada_diffuser.environments:ada/CheetahWind-S-v0", gain=2.0).unwrapped.gain)'
    told = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert told.stdout == "2.0\n"


# ---- environments of somebody else ----

THEIRS = """
import gymnasium, numpy
from gymnasium import spaces

class Theirs(gymnasium.Env):
    action_space = spaces.Box(-2.0, 2.0, (3,))

    def __init__(self, observations=spaces.Box(-9.0, 9.0, (5,)), actions=None):
        self.observation_space = observations
        self.action_space = actions or self.action_space

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.np_random.uniform(size=5), {}

    def step(self, action):
        self.steps += 1
        return self.np_random.uniform(size=5), -float(action @ action), self.steps == 7, False, {}

def policy(observation, context):
    assert context is None
    return 3 * observation[:3]

def rude(observation, context):
    return observation

gymnasium.register("theirs/Five-v0", Theirs, max_episode_steps=10)
gymnasium.register("theirs/Endless-v0", Theirs)
gymnasium.register("theirs/Choice-v0", Theirs, max_episode_steps=10, kwargs={"actions": spaces.Discrete(3)})
gymnasium.register("theirs/Dict-v0", Theirs, max_episode_steps=10, kwargs={"observations": spaces.Dict(a=spaces.Box(0, 1, (2,)))})
gymnasium.register("theirs/Picture-v0", Theirs, max_episode_steps=10, kwargs={"observations": spaces.Box(0, 255, (8, 8, 3))})
"""


@pytest.fixture
def theirs(tmp_path, monkeypatch):
    """A module `theirs` in the working directory, that has not been imported."""
    (tmp_path / "theirs.py").write_text(THEIRS)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("theirs", None)
    for name in [name for name in gym.registry if name.startswith("theirs/")]:
        del gym.registry[name]


def test_environments_of_somebody_else_fly_with_their_expert(theirs, capsys):
    """`--env module:id` was an unknown environment, and an environment without hidden context could not be collected at all."""
    flags = ["--env", "theirs:theirs/Five-v0", "--episodes", "3", "--quiet"]
    assert collect(["--out", "a.h5", *flags, "--expert", "theirs:policy"]) == 0
    episodes = load_episodes(Path("a.h5"))
    assert episodes.observations.shape == (21, 5) and episodes.actions.shape == (21, 3) and episodes.context is None
    assert np.allclose(episodes.actions, np.clip(3 * episodes.observations[:, :3], -2, 2), atol=1e-6), "no noise unless asked for"
    assert np.flatnonzero(episodes.terminals).tolist() == [6, 13, 20] and not episodes.timeouts.any()
    card = json.loads(Path("a.card.json").read_text())
    assert card["environment"]["id"] == "theirs:theirs/Five-v0" and card["expert"] == {"kind": "function", "name": "theirs:policy"}

    for name in ("b.h5", "c.h5"):
        assert collect(["--out", name, *flags, "--expert", "random", "--episode-steps", "4"]) == 0
    assert load_episodes(Path("b.h5")).timeouts.nonzero()[0].tolist() == [3, 7, 11]
    assert Path("b.h5").read_bytes() == Path("c.h5").read_bytes()
    capsys.readouterr()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--env", "theirs:theirs/Five-v0"], "--expert MODULE:FUNCTION"),
        (["--env", "theirs:theirs/Five-v0", "--expert", "theirs:rude"], "shape (5,), an action of theirs/Five-v0 has (3,)"),
        (["--env", "theirs:theirs/Five-v0", "--expert", "theirs:polite"], "no attribute 'polite'"),
        (["--env", "theirs:theirs/Endless-v0", "--expert", "random"], "--episode-steps"),
        (["--env", "theirs:theirs/Choice-v0", "--expert", "random"], "Discrete(3) as its actions"),
        (["--env", "theirs:theirs/Dict-v0", "--expert", "random"], "FlattenObservation"),
        (["--env", "theirs:theirs/Picture-v0", "--expert", "random"], "(8, 8, 3)"),
        (["--env", "theirs:theirs/Six-v0", "--expert", "random"], "unknown environment"),
        (["--env", "thiers:theirs/Five-v0"], "cannot import 'thiers'"),
        (["--env", "CartPole-v1", "--expert", "random"], "Discrete(2) as its actions"),
        (["--env", "no such name"], "no such name"),
    ],
)
def test_what_cannot_be_taken_is_told_in_one_sentence(theirs, capsys, flags, words):
    """A discrete or dict space ended in a traceback, after the episodes were begun."""
    assert collect(["--out", "a.h5", "--quiet", *flags]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1 and error.startswith("ada-collect: ")
    assert not Path("a.h5").exists()


def test_an_environment_is_one_class_that_says_all_of_itself(theirs, capsys):
    """Expert, noise, failure and length were looked up by the names of this package's own classes, in four other files."""
    (theirs / "calm.py").write_text(
        "from ada_diffuser.environments import CheetahWindS\n"
        "class Calm(CheetahWindS, name='calm', id='theirs/Calm-v0'):\n"
        "    episode_steps, action_noise, mean = 4, (0.5,), 0.0\n"
        "    def failed(self, episode_return): return True\n"
    )
    flags = ["--episodes", "2", "--quiet", "--expert-searches", "1", "--expert-iterations", "1"]
    assert collect(["--env", "calm:theirs/Calm-v0", "--out", "a.h5", *flags]) == 0
    card = json.loads(Path("a.card.json").read_text())
    assert (card["steps"], card["action_noise"], card["returns"]["failures"]) == (8, [0.5], 2)
    assert card["expert"]["recipe"]["env"] == "calm:theirs/Calm-v0"
    assert collect(["--env", "calm", "--out", "b.h5", *flags, "--expert", "a.expert.npz"]) == 0, "its short name, once it is imported"
    assert Path("a.h5").read_bytes() == Path("b.h5").read_bytes()
    del environments.NAMES["calm"], sys.modules["calm"]
    capsys.readouterr()


# ---- PointWind-S ----


def test_point_wind_follows_its_equations():
    env = environments.PointWindS(sigma=0.0)
    observation, _ = env.reset(seed=4)
    position, velocity = observation[:2].astype(float), observation[2:].astype(float)
    assert np.array_equal(velocity, np.zeros(2)) and np.abs(position).max() <= 1
    for action in ([1.0, -0.5], [-3.0, 0.25]):
        context = env.context.astype(float)
        observation, reward, *_ = env.step(np.array(action, np.float32))
        clipped = np.clip(action, -1, 1)
        velocity = velocity + 0.1 * (4 * clipped - 0.8 * velocity + context)
        position = position + 0.1 * velocity
        assert np.allclose(observation, np.concatenate([position, velocity]), atol=1e-6)
        assert reward == pytest.approx(-np.hypot(*position) - 0.05 * clipped @ clipped, abs=1e-6)


def test_point_wind_blows_along_one_line_with_the_stated_strength():
    env = environments.PointWindS(phase=0.0)
    _, info = env.reset(seed=4)
    contexts = [info["context"]] + [env.step(np.zeros(2, np.float32)) and env.context for _ in range(40)]
    strength = [2 + 2 * math.sin(0.2 * t) for t in range(41)]
    direction = contexts[0] / 2
    assert np.hypot(*direction) == pytest.approx(1, abs=1e-6)
    assert np.allclose(contexts, np.outer(strength, direction), atol=1e-5)


def test_point_wind_draws_wind_anew_in_each_episode():
    env = environments.PointWindS()
    first = env.reset(seed=1)[1]["context"]
    assert not np.allclose(first, env.reset()[1]["context"])


# ---- the cheetah's body ----


def test_the_body_is_gymnasiums_half_cheetah(tmp_path, monkeypatch):
    """Also where this package loads the file in another way, because MuJoCo logs a deprecation into the working directory."""
    monkeypatch.chdir(tmp_path)
    body, reference = HalfCheetahBody(), mujoco.MjModel.from_xml_path(str(XML))
    assert np.array_equal(body.model.body_mass, reference.body_mass)
    assert np.array_equal(body.model.dof_invweight0, reference.dof_invweight0)
    env = gym.make("HalfCheetah-v5").unwrapped
    theirs = env.reset(seed=9)[0]
    body.reset(np.random.Generator(np.random.PCG64(np.random.SeedSequence(9))))
    assert np.allclose(body.observation(), theirs, atol=1e-6)
    for action in np.random.default_rng(0).uniform(-1, 1, (10, 6)):
        theirs, _, _, _, info = env.step(action)
        speed = body.step(action, 0.0)
        assert np.allclose(body.observation(), theirs, atol=1e-5)
        assert speed == pytest.approx(info["x_velocity"], abs=1e-9)


def gust(wind_on, force, steps=5):
    """x travelled by a limp body in `steps` control steps against `force` N."""
    body = HalfCheetahBody(wind_on)
    body.reset(np.random.default_rng(0))
    start = body.x
    for _ in range(steps):
        body.step(np.zeros(6), force)
    return body.x - start


@pytest.mark.parametrize("wind_on", ["torso", "all_bodies", "rootx"])
def test_a_head_wind_pushes_the_cheetah_back_and_a_tail_wind_forth(wind_on):
    still = gust(wind_on, 0.0)
    assert gust(wind_on, 10.0) < still - 0.01
    assert gust(wind_on, -10.0) > still + 0.01


def test_wind_on_rootx_equals_wind_on_the_torso_and_all_bodies_is_stronger():
    still = gust("torso", 0.0, steps=1)
    torso, rootx, everything = (gust(where, 10.0, steps=1) - still for where in ("torso", "rootx", "all_bodies"))
    assert torso == pytest.approx(rootx, rel=0.35)
    assert everything < 2 * torso


def test_wind_is_a_force_along_x_and_no_torque():
    """A public wrapper sets `force = [0] * 5 + [w]`: a torque about z, which moves nothing in a planar body."""
    body = HalfCheetahBody()
    body.reset(np.random.default_rng(0))
    body.step(np.zeros(6), 7.0)
    applied = body.data.xfrc_applied
    torso = body.model.body("torso").id
    assert applied[torso].tolist() == [-7.0, 0, 0, 0, 0, 0]
    assert np.count_nonzero(applied) == 1


@pytest.mark.parametrize("wind_on", ["torso", "all_bodies", "rootx"])
def test_wind_does_not_outlive_the_episode_or_the_step(wind_on):
    body = HalfCheetahBody(wind_on)
    body.reset(np.random.default_rng(0))
    body.step(np.zeros(6), 7.0)
    body.step(np.zeros(6), 0.0)
    assert not body.data.xfrc_applied.any() and not body.data.qfrc_applied.any()
    body.step(np.zeros(6), 7.0)
    body.reset(np.random.default_rng(0))
    assert not body.data.xfrc_applied.any() and not body.data.qfrc_applied.any()


# ---- the cheetah's tasks ----


@pytest.mark.parametrize("name", CHEETAHS)
def test_cheetah_reward_is_speed_error_and_effort_of_the_clipped_action(name):
    env = environments.make(name).unwrapped
    env.reset(seed=1)
    for action in np.random.default_rng(0).uniform(-1.5, 1.5, (10, 6)).astype(np.float32):
        _, reward, _, _, info = env.step(action)
        target = info["context"][0] if name == "cheetah-vel-e" else 1.5
        clipped = np.clip(action, -1, 1)
        assert reward == pytest.approx(-abs(info["x_velocity"] - target) - 0.05 * clipped @ clipped, abs=1e-5)


def test_wind_s_is_the_papers_wind_at_phase_0_and_reaches_the_simulator():
    env = environments.make("cheetah-wind-s", phase=0.0, gain=2.0).unwrapped
    env.reset(seed=0)
    torso = env.body.model.body("torso").id
    for t in range(30):
        context = env.step(np.zeros(6, np.float32))[4]["context"][0]
        assert context == pytest.approx(2 * (5 + 5 * math.sin(0.5 * t)), abs=1e-5)
        assert env.body.data.xfrc_applied[torso, 0] == pytest.approx(-context, abs=1e-5)


def test_wind_s_draws_a_phase_in_each_episode():
    env = environments.make("cheetah-wind-s").unwrapped
    first = env.reset(seed=0)[1]["context"][0]
    assert len({first, *(env.reset()[1]["context"][0] for _ in range(4))}) == 5


def test_wind_e_is_constant_within_an_episode_and_follows_the_episode_number():
    env = environments.make("cheetah-wind-e", phase=0.0).unwrapped
    env.reset(seed=0)
    for i in range(4):
        winds = {env.step(np.zeros(6, np.float32))[4]["context"][0] for _ in range(3)}
        assert winds == {np.float32(10 + 5 * math.sin(0.8 * i))}
        env.reset()
    assert env.reset(options={"episode": 7})[1]["context"][0] == np.float32(10 + 5 * math.sin(0.8 * 7))
    assert env.reset(seed=1)[1]["context"][0] == 10.0, "a seed starts a new session"


def test_wind_e_keeps_its_phase_within_a_session():
    env = environments.make("cheetah-wind-e").unwrapped
    first = env.reset(seed=3)[1]["context"][0]
    env.reset()
    assert env.reset(options={"episode": 0})[1]["context"][0] == first


def test_vel_e_draws_from_its_targets():
    def speeds(**options):
        env = environments.make("cheetah-vel-e", **options).unwrapped
        return [env.reset(seed=0)[1]["context"][0]] + [env.reset()[1]["context"][0] for _ in range(30)]

    assert set(speeds()) == {1.0, 2.5}
    assert set(speeds(targets=[0.5])) == {0.5}
    uniform = speeds(targets="uniform")
    assert len(set(uniform)) == 31 and 0 <= min(uniform) < 1 and 2 < max(uniform) <= 3
    assert np.allclose(speeds(targets="lilac"), [1.5 + 1.5 * math.sin(0.5 * i) for i in range(31)], atol=1e-6)


def test_vel_e_draws_the_phase_of_lilac_in_each_session_where_it_is_wanted():
    """With the paper's phase every session has the same speeds, and another world's are no false ones."""

    def session(seed, **options):
        env = environments.make("cheetah-vel-e", targets="lilac", **options).unwrapped
        return np.array([env.reset(seed=seed)[1]["context"][0]] + [env.reset()[1]["context"][0] for _ in range(12)], np.float64)

    rows = 1.5 * np.column_stack([np.sin(0.5 * np.arange(13)), np.cos(0.5 * np.arange(13))])
    phases = []
    for seed in (0, 1):
        drawn = session(seed, phase=None)
        (cosine, sine), *_ = np.linalg.lstsq(rows, drawn - 1.5, rcond=None)
        phases.append(np.arctan2(sine, cosine))
        assert np.allclose(drawn, 1.5 + 1.5 * np.sin(0.5 * np.arange(13) + phases[-1]), atol=1e-6), "one phase in all of it"
    assert abs(phases[0] - phases[1]) > 0.01
    wave = 1.5 + 1.5 * np.sin(0.5 * np.arange(13) + 2.0)
    assert np.allclose(session(0, phase=2.0), wave, atol=1e-6) and np.allclose(session(1, phase=2.0), wave, atol=1e-6)


@pytest.mark.parametrize("name", HIDDEN)
def test_a_return_of_standing_still_counts_as_failed_and_an_experts_does_not(name):
    env = environments.make(name).unwrapped
    env.reset(seed=0)
    still = sum(env.step(np.zeros(env.action_space.shape, np.float32))[1] for _ in range(200))
    assert env.failed(still)
    assert not env.failed(EARNED.get(name, -50.0))
