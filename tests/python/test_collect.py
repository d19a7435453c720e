"""`ada-collect` writes the layout it promises, the same bytes for the same arguments, and clear errors."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
from server import descendants, gone

from ada_diffuser import environments
from ada_diffuser.collect import Job, collect
from ada_diffuser.commands.collect import main
from ada_diffuser.dataset import card_path, load_episodes, with_play
from ada_diffuser.experts import formula_of, load_expert
from ada_diffuser.experts.policy import CalledExpert

TINY = ["--episodes", "3", "--quiet", "--expert-searches", "1", "--expert-iterations", "1"]


def run(out, *flags):
    return main(["--out", str(out), *TINY, *flags])


@pytest.mark.parametrize("name", ["point-wind-s", "cheetah-wind-s"])
def test_same_arguments_same_bytes_and_another_seed_other_bytes(name, tmp_path):
    paths = [tmp_path / "a" / "x.h5", tmp_path / "b" / "x.h5"]
    for path in paths:
        assert run(path, "--env", name, "--seed", "5") == 0
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert run(tmp_path / "a" / "x.h5", "--env", name, "--seed", "6") == 0
    assert paths[0].read_bytes() != paths[1].read_bytes()


def test_layout_is_d4rls(tmp_path):
    path = tmp_path / "x.h5"
    assert run(path, "--env", "point-wind-s") == 0
    with h5py.File(path) as file:
        shapes = {name: (file[name].shape, file[name].dtype) for name in ("observations", "actions", "rewards", "infos/context")}
        assert shapes["observations"] == ((600, 4), np.float32)
        assert shapes["actions"] == ((600, 2), np.float32)
        assert shapes["rewards"] == ((600,), np.float32)
        assert shapes["infos/context"] == ((600, 2), np.float32)
        assert file["terminals"].dtype == file["timeouts"].dtype == np.bool_
        assert np.flatnonzero(file["timeouts"][()]).tolist() == [199, 399, 599] and not file["terminals"][()].any()
        noise = file["infos/action_noise"][()].reshape(3, 200)
        assert (noise == noise[:, :1]).all() and np.isin(noise, np.float32([0.1, 0.2, 0.3])).all()


def test_rows_hold_the_step_as_it_was_executed():
    """Row t: the state before the step, the clipped noisy action, its reward, the wind that blew in it."""
    job = Job("point-wind-s", {"sigma": 0.0}, 2, (0.5,), seed=1)
    episodes, failed = collect(job, formula_of(environments.PointWindS()))
    for start in (0, 200):
        rows = slice(start, start + 199)
        velocity = episodes.observations[rows, 2:]
        following = episodes.observations[start + 1 : start + 200]
        action, wind = episodes.actions[rows], episodes.context[rows]
        expected = velocity + 0.1 * (4 * action - 0.8 * velocity + wind)
        assert np.allclose(following[:, 2:], expected, atol=1e-5)
        cost = -np.linalg.norm(following[:, :2], axis=1) - 0.05 * (action**2).sum(1)
        assert np.allclose(episodes.rewards[rows], cost, atol=1e-5)
    assert np.abs(episodes.actions).max() == 1.0, "noise this large reaches the bounds, and what is stored is clipped"
    assert len(episodes.returns()) == 2 and episodes.returns().sum() == pytest.approx(episodes.rewards.sum(), rel=1e-4)
    assert np.array_equal(failed, episodes.returns() < -60)


def test_the_card_tells_what_the_file_is(tmp_path, capsys):
    path = tmp_path / "x.h5"
    assert run(path, "--env", "cheetah-wind-s", "--option", "gain=2", "--seed", "3", "--json") == 0
    card = json.loads(card_path(path).read_text())
    assert json.loads(capsys.readouterr().out) == card
    assert card["environment"] == {"id": "ada/CheetahWind-S-v0", "options": {"gain": 2}}
    assert card["file"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert (card["seed"], card["episodes"], card["steps"]) == (3, 3, 600)
    assert card["expert"]["recipe"]["options"] == {"gain": 2}
    assert "--option gain=2" in card["command"]
    returns = load_episodes(path).returns()
    assert card["returns"]["mean"] == pytest.approx(returns.mean(), abs=1e-3)
    assert card["returns"]["failures"] == 3, "an expert after one update stands still"


@pytest.mark.parametrize("flag", ["--option", "--env-option"])
def test_the_papers_speeds_are_collected_episode_by_episode(flag, tmp_path):
    path = tmp_path / "x.h5"
    assert run(path, "--env", "cheetah-vel-e", flag, "targets=lilac", "--episodes", "4", "--expert", "random") == 0
    speeds = load_episodes(path).context.reshape(4, 200)
    assert np.allclose(speeds, 1.5 + 1.5 * np.sin(0.5 * np.arange(4))[:, None], atol=1e-6)


def test_the_expert_beside_the_data_is_used_again_only_for_its_own_recipe(tmp_path, capsys):
    path, cache = tmp_path / "x.h5", tmp_path / "x.expert.npz"
    run(path, "--env", "cheetah-wind-s")
    first = cache.stat().st_mtime_ns
    run(path, "--env", "cheetah-wind-s", "--seed", "9")
    assert cache.stat().st_mtime_ns == first
    run(path, "--env", "cheetah-wind-s", "--option", "gain=2")
    assert cache.stat().st_mtime_ns != first and "another recipe" in capsys.readouterr().err


def test_a_given_expert_flies_instead(tmp_path):
    path = tmp_path / "x.h5"
    run(path, "--env", "cheetah-wind-s")
    expert = tmp_path / "x.expert.npz"
    assert run(tmp_path / "y.h5", "--env", "cheetah-wind-s", "--expert", str(expert)) == 0
    assert path.read_bytes() == (tmp_path / "y.h5").read_bytes()
    assert not (tmp_path / "y.expert.npz").exists()


def test_a_share_is_flown_blind_and_the_file_and_the_card_say_which(tmp_path):
    path = tmp_path / "x.h5"
    flags = ["--env", "pendulum-torque-s", "--episodes", "9", "--action-noise", "0", "--blind", "0.33", "--seed", "4"]
    assert run(path, *flags) == 0
    episodes, card = load_episodes(path), json.loads(card_path(path).read_text())
    flown_blind = episodes.blind.reshape(9, 200)
    assert episodes.blind.dtype == np.bool_ and (flown_blind == flown_blind[:, :1]).all() and flown_blind[:, 0].sum() == 3
    pilot = environments.PendulumTorqueS()
    for blind, observation, action, torque in zip(episodes.blind, episodes.observations, episodes.actions, episodes.context, strict=True):
        assert action == pytest.approx(pilot.expert_action(observation, np.zeros(1) if blind else torque), abs=1e-5)
    returns, blind = episodes.returns(), card["blind"]
    assert (blind["share"], blind["flown_blind"]["episodes"], blind["flown_seeing"]["episodes"]) == (0.33, 3, 6)
    assert blind["flown_blind"]["returns"]["mean"] == pytest.approx(returns[flown_blind[:, 0]].mean(), abs=1e-3)
    assert blind["flown_seeing"]["returns"]["mean"] == pytest.approx(returns[~flown_blind[:, 0]].mean(), abs=1e-3)
    assert blind["expert"]["told"] == [0.0] and "told" not in card["expert"]

    assert run(tmp_path / "again.h5", *flags) == 0
    assert path.read_bytes() == (tmp_path / "again.h5").read_bytes()
    assert run(tmp_path / "other.h5", *flags[:-1], "5") == 0
    assert not np.array_equal(load_episodes(tmp_path / "other.h5").blind, episodes.blind)


def test_play_is_flown_under_the_context_of_another_world(tmp_path):
    path = tmp_path / "x.h5"
    flags = ["--env", "pendulum-torque-s", "--episodes", "12", "--action-noise", "0", "--blind", "0.25", "--play", "0.5", "--seed", "4"]
    assert run(path, *flags) == 0
    episodes, card = load_episodes(path), json.loads(card_path(path).read_text())
    assert (episodes.play.reshape(12, 200).sum(axis=1) % 200 == 0).all() and not (episodes.play & episodes.blind).any()
    pilot = environments.PendulumTorqueS()
    told_truth = np.array([a == pytest.approx(pilot.expert_action(o, c), abs=1e-5) for o, a, c in _steps(episodes)])
    assert told_truth[~episodes.play & ~episodes.blind].all() and told_truth[episodes.play].mean() < 0.3  # at the bounds they agree
    card = card["play"]
    assert (card["share"], card["played"]["episodes"], card["demonstrated"]["episodes"]) == (0.5, 6, 6)
    played = episodes.play.reshape(12, 200)[:, 0]
    assert card["played"]["returns"]["mean"] == pytest.approx(episodes.returns()[played].mean(), abs=1e-3)

    assert run(tmp_path / "again.h5", *flags) == 0
    assert path.read_bytes() == (tmp_path / "again.h5").read_bytes()


def test_the_actions_of_play_say_nothing_of_the_context(tmp_path):
    path = tmp_path / "x.h5"
    assert run(path, "--env", "point-wind-s", "--episodes", "200", "--play", "0.5", "--action-noise", "0") == 0
    episodes = load_episodes(path)
    step = np.tile(np.arange(200) == 0, 200)  # the first: later ones show in the state what the wind did
    for play, least, most in ((False, 0.8, 1.0), (True, 0.0, 0.25)):
        at = step & (episodes.play == play)
        seen = np.column_stack([episodes.observations[at], np.ones(at.sum())])
        rest = [part - seen @ np.linalg.lstsq(seen, part, rcond=None)[0] for part in (episodes.actions[at], episodes.context[at])]
        assert least <= abs(np.corrcoef(rest[0][:, 0], rest[1][:, 0])[0, 1]) <= most, play


def _steps(episodes):
    return zip(episodes.observations, episodes.actions, episodes.context, strict=True)


def test_without_blind_episodes_nothing_is_said_of_them(tmp_path):
    assert run(tmp_path / "x.h5", "--env", "point-wind-s") == 0
    assert run(tmp_path / "y.h5", "--env", "point-wind-s", "--blind", "0") == 0
    assert (tmp_path / "x.h5").read_bytes() == (tmp_path / "y.h5").read_bytes()
    with h5py.File(tmp_path / "x.h5") as file:
        assert "blind" not in file["infos"]
    assert "blind" not in json.loads(card_path(tmp_path / "x.h5").read_text())


def wind_phase(winds):
    """`phi` of the winds of Cheetah-Wind-E in episodes 0, 1, ... of a session; that they have one is asserted."""
    turn = 0.8 * np.arange(len(winds))
    (cosine, sine), *_ = np.linalg.lstsq(5 * np.column_stack([np.sin(turn), np.cos(turn)]), winds - 10, rcond=None)
    phase = np.arctan2(sine, cosine)
    assert np.allclose(winds, 10 + 5 * np.sin(turn + phase), atol=1e-4), "not the winds of one session"
    return phase


def test_sessions_follow_one_another_and_the_file_says_which_episodes_do(tmp_path):
    path = tmp_path / "x.h5"
    flags = ["--env", "cheetah-wind-e", "--expert", "random", "--episode-steps", "2", "--episodes", "11", "--session-episodes", "4"]
    assert run(path, *flags) == 0
    with h5py.File(path) as file:
        session = file["infos/session"][()]
    assert session.dtype == np.int64 and session.tolist() == [0] * 8 + [1] * 8 + [2] * 6, "one a step; the last session is shorter"
    winds = load_episodes(path).context[::2, 0].astype(np.float64)
    phases = [wind_phase(winds[first : first + 4]) for first in (0, 4, 8)]
    assert len(set(np.round(phases, 2))) == 3
    with pytest.raises(AssertionError, match="not the winds of one session"):
        wind_phase(winds)  # a session that went on would seem to have another phase, too
    assert json.loads(card_path(path).read_text())["session_episodes"] == 4
    assert run(tmp_path / "again.h5", *flags) == 0
    assert path.read_bytes() == (tmp_path / "again.h5").read_bytes()


@pytest.mark.parametrize(("flags", "begins"), [([], [0]), (["--session-episodes", "2"], [0, 2, 4]), (["--session-episodes", "9"], [0])])
def test_a_seed_is_given_where_a_session_begins_and_nowhere_else(flags, begins, tmp_path, monkeypatch):
    seeds, reset = [], environments.PointWindS.reset

    def seen(self, *, seed=None, options=None):
        seeds.append(seed)
        return reset(self, seed=seed, options=options)

    monkeypatch.setattr(environments.PointWindS, "reset", seen)
    assert run(tmp_path / "x.h5", "--env", "point-wind-s", "--episodes", "5", *flags) == 0
    given = [seed for seed in seeds if seed is not None]
    assert [episode for episode, seed in enumerate(seeds) if seed is not None] == begins and len(set(given)) == len(begins)
    with h5py.File(tmp_path / "x.h5") as file:
        assert ("session" in file["infos"]) == bool(flags)
    assert ("session_episodes" in json.loads(card_path(tmp_path / "x.h5").read_text())) == bool(flags)


def test_a_session_is_blind_or_play_as_a_whole_and_the_other_world_lasts_as_long():
    told = []

    def expert(observation, context):
        told.append(context[0])
        return np.zeros(6)

    job = Job("cheetah-wind-e", {}, 36, (0.0,), seed=2, episode_steps=1, blind=1 / 6, play=0.5, session_episodes=3)
    episodes, _ = collect(job, CalledExpert(expert, {}), blind=CalledExpert(expert, {}))
    told, true = np.array(told, np.float64).reshape(12, 3), episodes.context.astype(np.float64).reshape(12, 3)
    blind, play = episodes.blind.reshape(12, 3), episodes.play.reshape(12, 3)
    assert (blind == blind[:, :1]).all() and (play == play[:, :1]).all() and not (blind & play).any()
    assert (blind[:, 0].sum(), play[:, 0].sum()) == (2, 6), "shares of the sessions"
    assert np.array_equal(told[~play[:, 0]], true[~play[:, 0]])
    other = [wind_phase(row) for row in told[play[:, 0]]]
    assert len(set(np.round(other, 2))) == 6 and not np.isclose(told[play[:, 0]], true[play[:, 0]]).all(axis=1).any()


def test_a_blind_expert_is_searched_for_kept_and_used_again(tmp_path):
    path, cache = tmp_path / "x.h5", tmp_path / "x.blind.npz"
    assert run(path, "--env", "cheetah-vel-e", "--blind", "1") == 0
    first = cache.stat().st_mtime_ns
    card = json.loads(card_path(path).read_text())
    assert card["blind"]["flown_seeing"] == {"episodes": 0, "returns": None} and card["blind"]["expert"]["recipe"]["targets"] == []
    assert card["blind"]["expert"]["recipe"]["blind"] is True and load_expert(cache).sizes(1) == (17, 6)
    assert run(path, "--env", "cheetah-vel-e", "--blind", "0.5", "--seed", "9") == 0
    assert cache.stat().st_mtime_ns == first
    given = ["--expert", str(tmp_path / "x.expert.npz"), "--blind-expert", str(cache)]
    assert run(tmp_path / "y.h5", "--env", "cheetah-vel-e", "--blind", "0.5", "--seed", "9", *given) == 0
    assert path.read_bytes() == (tmp_path / "y.h5").read_bytes() and not (tmp_path / "y.blind.npz").exists()


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (["--env", "point-wind-s", "--blind", "1.5"], "--blind"),
        (["--env", "point-wind-s", "--blind", "nan"], "--blind"),
        (["--env", "point-wind-s", "--play", "1"], "--play"),
        (["--env", "Pendulum-v1", "--expert", "random", "--play", "0.5"], "--play"),
        (["--env", "point-wind-s", "--play", "0.6", "--blind", "0.5"], "--play"),
        (["--env", "point-wind-s", "--blind-expert", "random"], "--blind"),
        (["--env", "Pendulum-v1", "--expert", "random", "--blind", "0.5"], "--blind-expert"),
        (["--env", "cheetah-rain"], "cheetah-wind-s"),
        (["--env", "point-wind-s", "--episodes", "0"], "--episodes"),
        (["--env", "point-wind-s", "--session-episodes", "0"], "--session-episodes must be at least 1"),
        (["--env", "point-wind-s", "--option", "sigma"], "NAME=VALUE"),
        (["--env", "point-wind-s", "--option", "sigmas=1"], "sigmas"),
        (["--env", "point-wind-s", "--action-noise", "a,b"], "--action-noise"),
        (["--env", "point-wind-s", "--action-noise=-1"], "--action-noise"),
        (["--env", "cheetah-wind-s", "--expert", "missing.npz"], "missing.npz"),
    ],
)
def test_wrong_arguments_are_named_and_write_nothing(flags, word, tmp_path, capsys):
    out = tmp_path / "x.h5"
    assert main(["--out", str(out), "--quiet", *flags]) == 2
    assert word in capsys.readouterr().err
    assert not out.exists()


def test_the_output_must_be_hdf5(tmp_path, capsys):
    assert run(tmp_path / "x.csv", "--env", "point-wind-s") == 2
    assert "--out" in capsys.readouterr().err


def test_an_environment_without_a_context_is_refused(tmp_path, capsys):
    run(tmp_path / "x.h5", "--env", "cheetah-vel-e")
    assert run(tmp_path / "y.h5", "--env", "Pendulum-v1", "--expert", str(tmp_path / "x.expert.npz")) == 2
    assert "Pendulum-v1" in capsys.readouterr().err
    assert run(tmp_path / "y.h5", "--env", "Pendulum-v1") == 2
    assert "--expert" in capsys.readouterr().err


def test_help_teaches_without_the_simulators():
    """The extra is not needed to learn that it is."""
    blocked = "import sys; sys.modules.update(dict.fromkeys(('gymnasium', 'mujoco', 'h5py', 'tqdm'))); "
    code = blocked + "from ada_diffuser.commands.collect import main; sys.exit(main(sys.argv[1:]))"
    told = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, check=True).stdout
    assert all(word in told for word in ("--env", "infos/context", "examples:", "cheetah-vel-e"))
    refused = subprocess.run([sys.executable, "-c", code, "--env", "point-wind-s", "--out", "x.h5"], capture_output=True, text=True)
    assert refused.returncode == 2 and "[mujoco]" in refused.stderr


def test_an_expert_of_another_shape_is_refused(tmp_path, capsys):
    run(tmp_path / "x.h5", "--env", "cheetah-vel-e")
    expert = tmp_path / "x.expert.npz"
    assert run(tmp_path / "y.h5", "--env", "point-wind-s", "--expert", str(expert)) == 2
    assert "expert" in capsys.readouterr().err


def test_other_data_sets_go_behind_as_play(tmp_path):
    """Pooled data of other gains, of which a planner imitates the first alone; what differs in columns is refused."""
    other, pooled = tmp_path / "other.h5", tmp_path / "pooled.h5"
    assert run(other, "--env", "point-wind-s", "--episodes", "2", "--seed", "5") == 0
    assert run(pooled, "--env", "point-wind-s", "--also", str(other)) == 0
    found, behind = load_episodes(pooled), load_episodes(other)
    rows = len(behind.rewards)
    assert not found.play[:-rows].any() and found.play[-rows:].all()
    assert np.array_equal(found.observations[-rows:], behind.observations) and len(found.returns()) == 5
    assert json.loads(card_path(pooled).read_text())["also"] == {"other.h5": {"episodes": 2, "steps": rows}}
    wrong = dataclasses.replace(behind, context=behind.context[:, :1])
    with pytest.raises(ValueError, match=r"infos/context of \(2,\) and \(1,\) columns do not go together"):
        with_play(behind, [wrong])
    sessions = [dataclasses.replace(behind, session=np.repeat([0, 1], rows // 2)) for _ in range(2)]
    assert list(np.unique(with_play(sessions[0], sessions[1:]).session)) == [0, 1, 2, 3]
    assert main(["--out", str(pooled), "--env", "point-wind-s", "--quiet", "--also", str(tmp_path / "none.h5")]) == 2


def test_a_search_that_is_killed_leaves_no_process(tmp_path: Path) -> None:
    """Two searched on for minutes for nobody, and then waited for ever."""
    words = ["--env", "cheetah-wind-s", "--quiet", "--out", str(tmp_path / "a.h5")]
    with subprocess.Popen([sys.executable, "-m", "ada_diffuser.commands.collect", *words]) as running:
        end = time.monotonic() + 60
        while len(started := descendants(running.pid)) < 3:  # two that search, and one of Python's own
            assert time.monotonic() < end
            time.sleep(0.05)
        time.sleep(2)  # they have imported what they need
        running.kill()
    for pid in started:
        gone(pid)
