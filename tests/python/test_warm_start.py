"""Sessions that begin with steps which were recorded before: by the client, and by the commands that drive environments."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from fake_server import Core, serving

from ada_diffuser import Client, Executed, InvalidInput
from ada_diffuser.commands import evaluate as evaluate_command
from ada_diffuser.commands import rollout as rollout_command
from ada_diffuser.dataset import Episodes, save_episodes
from ada_diffuser.messages import Chunk
from ada_diffuser.rollout import Trial, evaluate
from ada_diffuser.rollout.warm_start import STEPS_MAX, WarmStart

FACES = ("grpc", "http")
RNG = np.random.default_rng(0)
STATES = RNG.uniform(-0.5, 0.5, (8, 4)).astype(np.float32)
STEPS = [Executed(STATES[i], RNG.uniform(-1, 1, 2), reward=-0.1 * i) for i in range(6)]


def data_set(path: Path, lengths: tuple[int, ...]) -> Episodes:
    """Episodes of these lengths, which end by the task and by the clock in turn."""
    rows = sum(lengths)
    last = np.isin(np.arange(1, rows + 1), np.cumsum(lengths))
    by_task = last & np.isin(np.arange(1, rows + 1), np.cumsum(lengths)[::2])
    rng = np.random.default_rng(1)
    columns = [rng.normal(size=(rows, width)).astype(np.float32) for width in (4, 2)]
    episodes = Episodes(*columns, rng.normal(size=rows).astype(np.float32), by_task, last & ~by_task)
    save_episodes(episodes, path)
    return episodes


def substance(chunk: Chunk) -> tuple[bytes, ...]:
    return tuple(array.tobytes() for array in (chunk.actions, chunk.latent_mean, chunk.latent_log_var, chunk.predicted_state))


def test_a_session_that_is_handed_a_history_is_one_that_lived_it(address: str) -> None:
    """By both faces; with a border between two episodes too."""
    told: dict[str, list[Any]] = {}
    for face in FACES:
        with Client(f"{face}://{address}") as client:

            def answers(*history: Executed, client: Client = client) -> list[tuple[bytes, ...]]:
                with client.open_session("tiny", seed=9, history=history) as session:
                    return [substance(session.act(STATES[6])), substance(session.act(STATES[7], reward=0.5))]

            with client.open_session("tiny", seed=1) as session:
                session.act(STATES[7], STEPS[:4])
                session.reset(seed=9, keep_history=True)
                lived = [substance(session.act(STATES[6]))]
                lived.append(substance(session.act(STATES[7], reward=0.5)))
                session.reset(seed=1)
                session.act(STATES[7], STEPS[:4])
                session.reset(seed=1, keep_history=True)
                session.act(STATES[7], STEPS[4:5])
                session.reset(seed=9, keep_history=True)
                twice = [substance(session.act(STATES[6]))]
            assert answers(*STEPS[:4]) == lived != answers()
            assert answers(*STEPS[:4], Executed(), *STEPS[4:5])[:1] == twice != answers(*STEPS[:5])[:1]
            told[face] = [lived, twice]
    assert told["grpc"] == told["http"]


@pytest.mark.parametrize("face", FACES)
def test_a_history_arrives_as_it_is_and_once(face: str) -> None:
    core = Core()
    with serving(core, face) as url, Client(url) as client:
        client.open_session(history=[Executed([0.5, -1.5], reward=2), Executed(action=np.ones(2)), Executed(), Executed(reward=0)])
        client.open_session()
    assert core.histories == [[{"state": [0.5, -1.5], "reward": 2.0}, {"action": [1.0, 1.0]}, {}, {"reward": 0.0}], []]


def test_an_episode_of_a_data_set_is_a_history(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "data.h5"
    episodes = data_set(path, (3, 5, 4, STEPS_MAX + 2))
    for word, number, rows in [
        *(("0", 0, slice(0, 3)), ("1", 1, slice(3, 8)), ("2", 2, slice(8, 12)), ("-3", 1, slice(3, 8))),
        *((word, 3, slice(14, STEPS_MAX + 14)) for word in ("", "3", "-1")),
    ]:
        start = WarmStart.parse(f"{path}:{word}" if word else str(path))
        assert (start.path, start.episode, len(start.steps)) == (path, number, rows.stop - rows.start)
        told = [np.array([getattr(step, name) for step in start.steps]) for name in ("state", "action", "reward")]
        columns = (episodes.observations, episodes.actions, episodes.rewards)
        assert all(np.array_equal(one, column[rows]) for one, column in zip(told, columns, strict=True)), word
    monkeypatch.chdir(tmp_path)
    assert WarmStart.parse("data.h5:1").as_json() == {"file": "data.h5", "episode": 1, "steps": 5}
    path.rename(tmp_path / "data.h5:2")
    assert WarmStart.parse("data.h5:2").episode == 3, "a file of this name"


def test_each_session_begins_warm_and_each_episode_where_the_model_forgets(tmp_path: Path) -> None:
    data_set(tmp_path / "data.h5", (3, 5))
    start = WarmStart.load(tmp_path / "data.h5", 1)
    trial = Trial("point-wind-s", "tiny", episodes=5, seed=7, session_episodes=2, episode_steps=4, warm_start=start)
    core = Core(traits={"state_dim": 4})
    with serving(core, "grpc") as url, Client(url) as client:
        kept = evaluate(client, trial)
        begun = [len(history) for history in core.histories]
        # What it looks back on at first: the five steps, and then the acts of the episode before.
        first = [episode.latents[0][0] - 0.5 for episode in kept.episodes]
        assert first == [5, 5 + len(kept.episodes[0].latents), 5, 5 + len(kept.episodes[2].latents), 5]
        assert begun == [5] * 4 and not core.sessions, "one for the lane, and one for each of three sessions"
        core.histories.clear()
        forgotten = evaluate(client, replace(trial, forget=True, vector=3))
        assert {episode.latents[0][0] for episode in forgotten.episodes} == {5.5} and set(map(len, core.histories)) == {5}
        core.histories.clear()
        evaluate(client, replace(trial, withhold_rewards=True))
        assert all(set(step) == {"state", "action"} for history in core.histories for step in history)
        assert core.histories[0][4]["state"] == start.steps[4].state.tolist()
        core.histories.clear()
        evaluate(client, replace(trial, warm_start=None))
        assert not any(core.histories)


def test_the_commands_begin_warm(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = tmp_path / "data.h5"
    data_set(data, (3, 5))
    words = ["--env", "point-wind-s", "--url", address, "--episodes", "2", "--seed", "3", "--episode-steps", "6"]
    returns = {}
    for name, flags in (("cold", []), ("last", ["--warm-start", str(data)]), ("first", ["--warm-start", f"{data}:0"])):
        for command, more in ((rollout_command, ["--face", "http"]), (evaluate_command, ["--markdown"])):
            out = tmp_path / "out.json"
            assert command.main([*words, *flags, *more, "--json", str(out)]) == 0
            stored = json.loads(out.read_text())
            stored = stored if isinstance(stored, dict) else stored[0]
            assert returns.setdefault(name, stored["returns"]) == stored["returns"], "both commands run the same"
            steps = {"last": {"episode": 1, "steps": 5}, "first": {"episode": 0, "steps": 3}}.get(name)
            assert stored.get("warm_start") == (steps and {"file": str(data), **steps})
    assert len({tuple(values) for values in returns.values()}) == 3
    capsys.readouterr()


def test_a_warm_start_that_cannot_be_is_said_before_the_first_episode(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, other = tmp_path / "data.h5", tmp_path / "other.h5"
    data_set(data, (3, 5))
    with h5py.File(other, "w") as file:
        file["observations"] = np.zeros((3, 4))
    (tmp_path / "text.h5").write_text("no HDF5")
    for word, says in [
        (f"{data}:2", "has 2 episodes, and none with the number 2"),
        (f"{data}:-3", "has 2 episodes, and none with the number -3"),
        (f"{data}:last", "'last' is no whole number"),
        (f"{tmp_path}/missing.h5", "missing.h5"),
        (f"{tmp_path}/missing.h5:1", "missing.h5"),
        (f"{tmp_path}/text.h5", "text.h5: is no data set of ada-collect"),
        (str(other), "other.h5: is no data set of ada-collect"),
    ]:
        for command in (rollout_command, evaluate_command):
            words = ["--env", "point-wind-s", "--url", "127.0.0.1:1", "--wait", "0", "--warm-start", word]
            assert command.main(words) == 1
            told = capsys.readouterr()
            assert says in told.err and told.err.count("\n") == 1 and not told.out, told.err
    core = Core(traits={"state_dim": 4}, keeps_history=False)
    with serving(core, "http") as url:
        words = ["--env", "point-wind-s", "--episodes", "2", "--warm-start", str(data)]
        assert rollout_command.main([*words, "--url", url]) == 1
        assert "REQUEST_INVALID" in capsys.readouterr().err and not core.seen
    with Client(f"grpc://{address}") as client, pytest.raises(InvalidInput) as wrong:
        evaluate(client, Trial("point-wind-s", warm_start=WarmStart(data, 0, (Executed([0.0] * 3),))))
    assert wrong.value.field == "history[0].state"
