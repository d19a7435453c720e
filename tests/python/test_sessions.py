"""Episodes that follow one another: what goes on between them in the environment and in the model, and what is said of them.

The model is that of the double: whether one may keep its history depends on what it was trained on, and here it is to be seen.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from fake_server import Core, serving
from gymnasium import spaces

from ada_diffuser import Client
from ada_diffuser.commands import evaluate as evaluate_command
from ada_diffuser.messages import Missing, Model, SamplerOptions, Timings, Trained
from ada_diffuser.rollout import ActLog, Episode, Evaluation, Trial, evaluate
from ada_diffuser.rollout.readout import Readout, fit, read
from ada_diffuser.rollout.report import outcome, readout_table, session_table
from ada_diffuser.rollout.result import mean_and_error
from ada_diffuser.rollout.seeds import by_recipe

RESETS: list[int | None] = []
"""What the environments below were reset with."""


class Lasting(gymnasium.Env[Any, Any]):
    """A wind that is drawn once a session and is stronger by `gain` in each of its episodes, which have 3 to 5 steps."""

    observation_space, action_space = spaces.Box(-9.0, 9.0, (2,)), spaces.Box(-1.0, 1.0, (2,))

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        RESETS.append(seed)
        self.wind = self.np_random.normal() if seed is not None else self.wind + self.gain
        self.steps_left = self.np_random.integers(3, 6)
        self.place = self.np_random.uniform(-1, 1, size=2)
        return self.place, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps_left -= 1
        self.place = self.place + 0.1 * np.clip(action, -1, 1) + 0.1 * self.wind
        return self.place, -float(np.linalg.norm(self.place)), self.steps_left == 0, False, {"context": np.array([self.wind])}


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    RESETS.clear()
    gymnasium.register("Lasting-v0", Lasting, max_episode_steps=9)
    yield
    gymnasium.registry.pop("Lasting-v0")


@pytest.fixture
def core() -> Core:
    return Core()


@pytest.fixture
def url(core: Core) -> Iterator[str]:
    with serving(core, "grpc") as url:
        yield url


SEVEN = Trial("Lasting-v0", episodes=7, seed=40, session_episodes=3)


def ran(url: str, trial: Trial) -> Evaluation:
    with Client(url) as client:
        return evaluate(client, trial)


def winds(result: Evaluation) -> list[float]:
    return [float(episode.contexts[0][0]) for episode in result.episodes]


@pytest.mark.parametrize("forget", [False, True])
def test_environment_and_model_go_on_within_a_session(core: Core, url: str, forget: bool) -> None:
    result = ran(url, replace(SEVEN, forget=forget))
    assert RESETS == [40, None, None, 41, None, None, 42]
    assert [keep for _, _, keep in core.resets] == [not forget and place > 0 for place in (0, 1, 2, 0, 1, 2, 0)]
    seeds = [seed for _, seed, _ in core.resets]
    assert seeds[::3] == [40, 41, 42] and len(set(seeds)) == 7, "each episode has noise of its own"
    assert [(episode.seed, episode.index) for episode in result.episodes] == [
        *((40, 0), (40, 1), (40, 2), (41, 0), (41, 1), (41, 2), (42, 0))
    ]
    assert np.diff(winds(result)[:3]) == pytest.approx(1) and np.diff(winds(result)[3:6]) == pytest.approx(1)


def test_sessions_are_the_same_alone_and_side_by_side(url: str) -> None:
    """Their episodes have different lengths, so that one session is in its second while another is in its first."""
    alone = ran(url, SEVEN)
    assert len({len(episode.rewards) for episode in alone.episodes}) > 1
    for vector in (2, 9):
        beside = ran(url, replace(SEVEN, vector=vector))
        assert np.array_equal(beside.returns, alone.returns) and winds(beside) == winds(alone)
    apart = ran(url, replace(SEVEN, episodes=3, session_episodes=1))
    assert np.array_equal(apart.returns, alone.returns[[0, 3, 6]]), "first episodes have the seeds that episodes by themselves have"


def test_a_model_that_forgets_sees_the_same_and_knows_less(url: str) -> None:
    kept, forgotten = ran(url, SEVEN), ran(url, replace(SEVEN, forget=True))
    assert winds(kept) == winds(forgotten)
    before = 0
    for one, other in zip(kept.episodes, forgotten.episodes, strict=True):
        before = before if one.index else 0
        assert [episode.latents[0][0] - 0.5 for episode in (one, other)] == [before, 0], "acts of the session that it looks back on"
        before += len(one.latents)


def test_a_model_that_may_keep_no_history_is_refused_before_the_first_episode(
    core: Core, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    core.keeps_history = False
    words = ["--env", "Lasting-v0", "--url", url, "--episodes", "4", "--session-episodes", "2"]
    assert evaluate_command.main(words) == 1
    told = capsys.readouterr()
    assert "REQUEST_INVALID" in told.err and told.err.count("\n") == 1 and not core.seen and told.out == ""
    assert evaluate_command.main([*words, "--forget"]) == 0


def placed(returns: list[list[float]], name: str = "fake", failed: tuple[int, int] | None = None) -> Evaluation:
    """An evaluation of sessions that earned this."""
    episodes = [
        Episode(seed, rewards=[value], index=index, failed=(seed, index) == failed)
        for seed, session in enumerate(returns)
        for index, value in enumerate(session)
    ]
    box = np.ones(1, np.float32)
    trained = Trained((1,), (1,), Missing(state=False, action=False, reward=False))
    model = Model(name, "ab" * 32, True, 1, 1, 8, 4, 1, 2, 10, -box, box, SamplerOptions(), True, trained)
    trial = Trial("point-wind-s", name, len(episodes), session_episodes=len(returns[0]))
    return Evaluation(trial, model, SamplerOptions(kappa=0.0), episodes, ActLog([1.0], 1, 0, 1, [Timings(1, 2, 3, 6)]), 1.0)


def test_a_mean_of_groups_has_the_error_over_the_groups() -> None:
    groups = [np.array([1.0, 3.0]), np.array([5.0, 7.0]), np.array([8.0, 12.0])]
    means = [group.mean() for group in groups]
    assert mean_and_error(groups) == pytest.approx((6.0, np.std(means, ddof=1) / np.sqrt(3)))
    # One of two groups is three times as long: 0.75 and 0.25 of the mean, each so many times its distance from it.
    assert mean_and_error([np.zeros(3), np.full(1, 8.0)]) == pytest.approx((2.0, np.sqrt(2 * ((0.75 * 2) ** 2 + (0.25 * 6) ** 2))))
    assert mean_and_error([np.array([1.0, 5.0])]) == (3.0, 0.0)


def test_returns_are_told_by_the_place_in_the_session() -> None:
    """Sessions differ by 10, episodes within one by 2: over episodes the error would be less than half of what it is."""
    result = placed([[-10.0, -8.0], [-20.0, -18.0], [-30.0]], failed=(1, 1))
    first, second = result.by_index
    assert (first.index, first.sessions, first.mean_return, first.failures) == (0, 3, -20.0, 0)
    assert first.standard_error == pytest.approx(10 / np.sqrt(3))
    assert (second.index, second.sessions, second.mean_return, second.standard_error, second.failures) == (1, 2, -13.0, 5.0, 1)
    whole = placed([[-10.0, -8.0], [-20.0, -18.0], [-30.0, -28.0]])
    assert whole.standard_error == pytest.approx(10 / np.sqrt(3)) and whole.mean_return == -19
    stored = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert stored["by_episode"][1] == {"episode": 1, "sessions": 2, "mean_return": -13.0, "standard_error": 5.0, "failures": 1}
    assert (stored["session_episodes"], stored["keep_history"]) == (2, True)
    assert placed([[-1.0], [-2.0]]).as_json().keys().isdisjoint(("by_episode", "session_episodes", "keep_history"))
    rows = session_table([result, replace(whole, trial=replace(whole.trial, forget=True))], ["kappa"]).splitlines()
    assert rows[2] == "| point-wind-s | fake | 0 | kept | 3 | -20.00 ± 5.77 | -13.00 ± 5.00 |"
    assert rows[3] == "| point-wind-s | fake | 0 | forgotten | 3 | -20.00 ± 5.77 | -18.00 ± 5.77 |"
    assert "by episode -20.00 -13.00" in outcome(result) and "by episode" not in outcome(placed([[-1.0], [-2.0]]))


def test_training_seeds_have_the_error_over_sessions_and_sessions_groups_of_their_own() -> None:
    results = [placed([[-10.0, -8.0], [-20.0, -18.0]], f"a-seed{seed}") for seed in (0, 1)]
    (group,) = by_recipe(results)
    assert group.standard_error == pytest.approx(5.0)
    results[1] = replace(results[1], trial=replace(results[1].trial, forget=True))
    assert not by_recipe(results), "another question was asked of the second"


def sessions_read(count: int = 12, length: int = 3, steps: int = 40) -> list[Episode]:
    """Latents that know the context from step 10 on in the first episode of a session, and always in the later ones."""
    played = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        for index in range(length):
            contexts = [rng.normal(size=1).astype(np.float32) for _ in range(steps)]
            latents = [rng.normal(size=1) if index == 0 and step < 10 else context for step, context in enumerate(contexts)]
            episode = Episode(seed, rewards=[0.0] * steps, contexts=contexts, act_steps=list(range(steps)), index=index)
            episode.latents = [np.asarray(latent, np.float32) for latent in latents]
            played.append(episode)
    return played


def test_what_later_episodes_know_at_once_is_told_apart_from_the_first_ones() -> None:
    found = fit(sessions_read())
    assert isinstance(found, Readout) and found.first_shown == 6 * 3
    first, later = ({error.age: error for error in found.by_age(place=place)} for place in ("first", "later"))  # type: ignore[arg-type]
    assert list(first) == list(later) == [(0, 40), (0, 10), (10, 30), (30, 40)]
    assert first[0, 10].mse > 1 and max(later[0, 10].mse, first[10, 30].mse) < 0.1
    assert (first[0, 10].episodes, later[0, 10].episodes) == (6, 12)
    (whole,) = found.by_age(((0, 10),))
    assert whole.mse == pytest.approx((first[0, 10].mse + 2 * later[0, 10].mse) / 3), "one scale for all"


def test_a_readout_is_fitted_on_whole_sessions_and_its_error_is_over_sessions() -> None:
    """Episodes of one session on both sides would let a map be judged on what it was fitted on."""
    assert "two sessions" in str(fit(sessions_read(count=1)))
    three = fit(sessions_read(count=3, length=5))
    assert isinstance(three, Readout) and three.first_shown == 10
    played = sessions_read(count=4)
    for episode in played[9:]:
        episode.latents = [np.zeros(1, np.float32)] * 40  # nothing is known in the last session
    found = fit(played)
    assert isinstance(found, Readout)
    (error,) = found.by_age(((10, None),), "later")
    assert error.mse == pytest.approx(0.5, abs=0.15) and error.standard_error == pytest.approx(error.mse, rel=0.1)


def test_rows_of_a_readout_say_which_episodes() -> None:
    result = replace(placed([[0.0] * 3] * 12), episodes=sessions_read())
    rows = json.loads(json.dumps(read(result).rows(), allow_nan=False))
    assert [(row["episode"], row["age"]) for row in rows] == [
        (place, age) for place in ("first", "later") for age in ([0, 40], [0, 10], [10, 30], [30, 40])
    ]
    lines = readout_table([read(result)], []).splitlines()
    assert len(lines) == 4 and len({line.count("|") for line in lines}) == 1 and "| steps 0 to 9 |" in lines[0]
    assert lines[2].startswith("| point-wind-s | fake | filter | first |") and "| filter | later |" in lines[3]
    alone = replace(result, trial=replace(result.trial, session_episodes=1))
    assert not any("episode" in row for row in read(alone).rows())
    assert "| latent | steps 0 to 39 |" in readout_table([read(alone)], [])


def test_the_command_evaluates_in_sessions(url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--env", "Lasting-v0", "--url", url, "--episodes", "10", "--session-episodes", "3", "--seed", "40"]
    stored = []
    for name, flags in (("kept", []), ("forgotten", ["--forget", "--markdown"])):
        path = tmp_path / f"{name}.json"
        assert evaluate_command.main([*words, "--readout", "--json", str(path), *flags]) == 0
        told = capsys.readouterr()
        assert f"| Lasting-v0 | fake | {name} | 4 |" in told.out and told.out.count("\n\n") == 2
        assert ("by episode" in told.err) != ("--markdown" in flags)
        stored.append(json.loads(path.read_text())[0])
    kept, forgotten = stored
    assert (kept["keep_history"], forgotten["keep_history"]) == (True, False)
    assert [row["sessions"] for row in kept["by_episode"]] == [4, 3, 3]
    assert kept["by_episode"] == forgotten["by_episode"] and kept["readout"] != forgotten["readout"], "the double acts blindly"
    assert {row["episode"] for row in kept["readout"]} == {"first", "later"}


def test_the_environment_has_its_options(url: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`cheetah-vel-e` could not be told to have lilac's speeds, which are what lasts there over episodes."""
    words = ["--env", "Lasting-v0", "--url", url, "--episodes", "2", "--session-episodes", "2"]
    stored = []
    for flags in ([], ["--env-option", "gain=5"]):
        assert evaluate_command.main([*words, *flags, "--json", str(tmp_path / "a.json")]) == 0
        stored.append(json.loads((tmp_path / "a.json").read_text())[0])
    plain, strong = stored
    assert strong["env_options"] == {"gain": 5} and "env_options" not in plain
    assert strong["returns"][0] == plain["returns"][0] and strong["returns"][1] != plain["returns"][1]
    capsys.readouterr()
    assert evaluate_command.main(["--env", "Lasting-v0", "--env-option", "gains=5", "--url", "127.0.0.1:1", "--wait", "0"]) == 1
    assert "gains" in capsys.readouterr().err


def test_words_that_make_no_sessions_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for words, names in [
        (["--session-episodes", "0"], "--session-episodes must be at least 1"),
        (["--forget"], "--forget belongs to --session-episodes"),
        (["--choose", "models/tiny", "--session-episodes", "2"], "takes no --session-episodes"),
    ]:
        assert evaluate_command.main(["--env", "Lasting-v0", "--url", "127.0.0.1:1", "--wait", "0", *words]) == 1
        told = capsys.readouterr()
        assert names in told.err and told.err.count("\n") == 1 and told.out == "", told
