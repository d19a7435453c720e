"""What an oracle is told: the context of now and of the steps to come, as the environment has it, and nothing is changed by asking."""

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

from ada_diffuser import Client, SamplerOptions, environments
from ada_diffuser.commands import evaluate as evaluate_command
from ada_diffuser.commands import rollout as rollout_command
from ada_diffuser.rollout import Evaluation, Trial, evaluate

SIZES = {"state_dim": 4, "action_dim": 2}
#: Of the double: a plan of 4 positions, and chunks of 1 action unless the session says another.
PLAN = 4


@pytest.mark.parametrize("name", environments.hidden())
def test_what_comes_is_told_and_nothing_changed(name: str) -> None:
    """Two episodes each: what is drawn in the second one must not depend on how far ahead the first was asked for."""
    asked, quiet = environments.make(name), environments.make(name)
    foretold: list[np.ndarray] = []
    for episode in range(2):
        seed = 7 if episode == 0 else None
        (state, facts), (other_state, other_facts) = asked.reset(seed=seed), quiet.reset(seed=seed)
        rng = np.random.default_rng(episode)
        for step in range(60):
            assert np.array_equal(state, other_state) and np.array_equal(facts["context"], other_facts["context"]), step
            told = asked.unwrapped.coming_context(9)
            assert told.shape == (9, len(facts["context"])) and told.dtype == np.float32
            assert np.array_equal(told, asked.unwrapped.coming_context(9)), "to ask is to draw nothing"
            foretold.append(told)
            action = rng.uniform(-1, 1, asked.action_space.shape).astype(np.float32)
            (state, _, over, _, facts), (other_state, _, _, _, other_facts) = asked.step(action), quiet.step(action)
            for ahead in range(min(step + 1, 9)):
                assert np.array_equal(foretold[-1 - ahead][ahead], facts["context"]), f"step {step} was foretold {ahead} steps before"
            if over:
                break
        foretold.clear()
    asked.close()
    quiet.close()


def test_a_wind_turns_within_what_is_told() -> None:
    """Without a turn the test above would say nothing of a task that draws as it goes."""
    env = environments.make("cheetah-gale-s", change=0.3)
    env.reset(seed=3)
    assert set(env.unwrapped.coming_context(40)[:, 0].tolist()) == {-40.0, 15.0}
    env.close()


@pytest.fixture
def core() -> Core:
    return Core()


@pytest.fixture(params=["grpc", "http"])
def url(core: Core, request: pytest.FixtureRequest) -> Iterator[str]:
    with serving(core, request.param) as url:
        yield url


def ran(url: str, trial: Trial) -> Evaluation:
    with Client(url) as client:
        return evaluate(client, trial)


def told(core: Core) -> list[Any]:
    return [observation.get("context") for _, _, observation in core.seen]  # type: ignore[attr-defined]


POINT = Trial("point-wind-s", episodes=2, seed=5, episode_steps=7)


def test_longer_chunks_look_further_ahead(core: Core, url: str) -> None:
    core.traits = {**SIZES, "context": {"dim": 2, "future": "known"}}
    ran(url, replace(POINT, options=SamplerOptions(action_horizon=3)))
    assert np.shape(told(core)[0]) == (PLAN + 2, 2)


@pytest.mark.parametrize("vector", [1, 2])
def test_an_oracle_of_the_future_is_told_the_coming_steps(core: Core, url: str, vector: int) -> None:
    core.traits = {**SIZES, "context": {"dim": 2, "future": "known"}}
    result = ran(url, replace(POINT, vector=vector))
    first = [rows for (name, _, _), rows in zip(core.seen, told(core), strict=True) if name == "s0"][:3]
    assert [np.shape(rows) for rows in first] == [(PLAN, 2)] * 3, "a chunk of the double has 3 actions: acts in steps 0, 3 and 6"
    winds = np.array(result.episodes[0].contexts)
    assert np.array_equal(first[0], winds[:PLAN]) and np.array_equal(first[1], winds[3:7]) and np.array_equal(first[2][0], winds[6])


def test_an_oracle_of_what_holds_is_told_that_of_now(core: Core, url: str) -> None:
    """`info["context"]` of a step is that of the step before the act: where the environment can say it, it says that of now."""
    core.traits = {**SIZES, "context": {"dim": 2, "future": "held"}}
    result = ran(url, POINT)
    winds = np.array(result.episodes[0].contexts)
    assert np.array_equal(np.array(told(core)[:3])[:, 0], winds[[0, 3, 6]])


def test_another_model_is_told_nothing(core: Core, url: str) -> None:
    core.traits = dict(SIZES)
    ran(url, POINT)
    assert told(core) == [None] * 6


class Plain(gymnasium.Env[Any, Any]):
    """Somebody else's: it tells its context in `info`, or not at all."""

    observation_space, action_space = spaces.Box(-9.0, 9.0, (4,)), spaces.Box(-1.0, 1.0, (2,))

    def __init__(self, tells: bool = True, ahead: int = 0) -> None:
        self.tells, self.ahead = tells, ahead

    def coming_context(self, steps: int) -> np.ndarray | None:
        return np.zeros((min(steps, self.ahead), 1)) if self.ahead else None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(4, np.float32), self._facts()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(4, np.float32), 0.0, False, False, self._facts()

    def _facts(self) -> dict[str, Any]:
        return {"context": 0.5} if self.tells else {}


@pytest.fixture
def plain() -> Iterator[None]:
    gymnasium.register("Plain-v0", Plain, max_episode_steps=4)
    yield
    gymnasium.registry.pop("Plain-v0")


def test_what_info_tells_holds(core: Core, url: str, plain: None) -> None:
    core.traits = {**SIZES, "context": {"dim": 1, "future": "held"}}
    ran(url, Trial("Plain-v0", episodes=1))
    assert told(core) == [[[0.5]], [[0.5]]]


@pytest.mark.parametrize(
    ("words", "context", "part"),
    [
        (["--env", "Plain-v0"], {"dim": 1, "future": "known"}, "has no `coming_context(steps)`"),
        (["--env", "Plain-v0", "--env-option", "tells=false"], {"dim": 1, "future": "held"}, "nor tells `info"),
        (["--env", "Plain-v0"], {"dim": 2, "future": "held"}, "of shape (1, 2), and the environment tells (1, 1)"),
        (["--env", "point-wind-s"], {"dim": 1, "future": "known"}, "of shape (4, 1), and the environment tells (4, 2)"),
    ],
)
def test_an_environment_that_cannot_tell_is_named_before_the_first_episode(
    core: Core, url: str, plain: None, capsys: pytest.CaptureFixture[str], words: list[str], context: dict[str, Any], part: str
) -> None:
    core.traits = {**SIZES, "context": context}
    assert evaluate_command.main([*words, "--url", url, "--episodes", "1"]) == 1
    error = capsys.readouterr().err
    assert part in error and error.count("\n") == 1 and not core.seen


def test_what_is_not_told_to_one_setting_is_said_before_any_is_run(
    core: Core, url: str, plain: None, capsys: pytest.CaptureFixture[str]
) -> None:
    core.traits = {**SIZES, "context": {"dim": 1, "future": "known"}}
    words = ["--env", "Plain-v0", "--env-option", f"ahead={PLAN}", "--url", url, "--episodes", "1", "--set", "action_horizon=1,2"]
    assert evaluate_command.main(words) == 1
    assert "of shape (5, 1), and the environment tells (4, 1)" in capsys.readouterr().err and not core.seen


def test_both_commands_tell_it_and_keep_what_plans_are_worth(core: Core, url: str, tmp_path: Path) -> None:
    core.traits = {**SIZES, "guide": True, "context": {"dim": 2, "future": "known"}}
    words = ["--env", "point-wind-s", "--url", url, "--episodes", "2", "--episode-steps", "7", "--json", str(tmp_path / "out.json")]
    assert rollout_command.main(words) == 0
    alone = json.loads((tmp_path / "out.json").read_text())
    assert evaluate_command.main([*words, "--set", "told_goal=[0.5,0.25],[1,0]", "--seed", "0"]) == 0
    side_by_side = json.loads((tmp_path / "out.json").read_text())
    assert all(np.shape(rows) == (PLAN, 2) for rows in told(core))
    # Acts 1, 2, 3 of each episode, worth -1, -2, -3.
    for entry in (alone, *side_by_side):
        assert (entry["passes_per_act"], entry["mean_value"]) == (2.0, -2.0)
    assert [entry["options"]["told_goal"] for entry in side_by_side] == [[0.5, 0.25], [1.0, 0.0]]
    core.traits["guide"] = False
    assert rollout_command.main(words) == 0
    assert "mean_value" not in json.loads((tmp_path / "out.json").read_text())
