"""Maze2D: the mazes, their reward and goals, the pilot that knows the way, and the goal that a model is told."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_server import Core, serving
from PIL import Image
from server import ROOT, running

from ada_diffuser import Client, SamplerOptions, environments
from ada_diffuser.collect import Job, collect
from ada_diffuser.commands import rollout as rollout_command
from ada_diffuser.commands.collect import main as collect_command
from ada_diffuser.dataset import load_episodes
from ada_diffuser.experts import formula_of
from ada_diffuser.rollout import Episode, Trial, evaluate
from ada_diffuser.rollout.film import Panel, save_film

TRAINER = Path(os.environ.get("ADA_TRAINER", ROOT / "target/release/ada-trainer"))
MAZES = {"maze2d-umaze": (300, (5, 5), 7), "maze2d-medium": (600, (8, 8), 26), "maze2d-large": (800, (9, 12), 46)}
"""Steps of an episode, rows and columns, and cells that are free."""


@pytest.mark.parametrize("name", MAZES)
def test_an_episode_is_as_long_as_d4rls_and_its_start_and_goal_are_drawn(name):
    env, (steps, shape, free) = environments.make(name), MAZES[name]
    maze = env.unwrapped
    assert environments.steps_max(env) == steps and maze.walls.shape == shape and (~maze.walls).sum() == free
    places = []
    for seed in range(40):
        position = env.reset(seed=seed)[0][:2]
        places.append((maze.cell(position), maze.cell(maze.goal)))
        assert not maze.walls[places[-1][0]] and not maze.walls[places[-1][1]] and places[-1][0] != places[-1][1]
        for point in (position, maze.goal):
            assert np.abs(point - maze.middle(maze.cell(point))).max() <= 0.25 + 1e-6
    assert len(set(places)) > 12 and env.reset(seed=3)[0].tolist() == env.reset(seed=3)[0].tolist()


def test_a_step_earns_1_within_half_a_cell_of_the_goal_and_never_ends_the_episode():
    env = environments.make("maze2d-umaze")
    for seed in (1, 2):
        observation, _ = env.reset(seed=seed)
        earned = []
        for _ in range(300):
            observation, reward, terminated, truncated, info = env.step(env.unwrapped.expert_action(observation, env.unwrapped.goal))
            near = float(np.linalg.norm(observation[:2] - env.unwrapped.goal))
            assert reward == (near <= 0.5) == info["success"] or abs(near - 0.5) < 1e-6
            assert not terminated and truncated == (len(earned) == 299)
            earned.append(reward)
        assert 0 < sum(earned) < 300


@pytest.mark.parametrize("name", MAZES)
def test_the_pilot_arrives_and_stays_whatever_is_drawn(name):
    """Every episode, and the noisy ones of its data too; its law knows nothing but the maze, what it sees, and the goal."""
    env = environments.make(name)
    pilot = formula_of(env)
    job = Job(name, {}, 6, (0.0, 0.4), seed=1)
    episodes, failed = collect(job, pilot)
    assert not failed.any()
    scores = [environments.measures(env, value) for value in episodes.returns()]
    assert all(one["success"] == 1.0 for one in scores) and np.mean([one["score"] for one in scores]) > 100
    last = np.flatnonzero(episodes.timeouts)
    assert len(last) == 6 and not episodes.terminals.any()
    assert np.allclose(episodes.observations[last, :2], episodes.goal[last], atol=0.2), "it stays there"
    assert len(np.unique(episodes.goal, axis=0)) == 6, "one goal an episode"


def test_the_way_is_the_shortest():
    maze = environments.make("maze2d-umaze").unwrapped
    steps, cell = 0, (1, 1)
    while cell != (3, 1):
        cell, steps = maze._way_to((3, 1))[cell], steps + 1
    assert steps == 6, "round the U"
    large = environments.make("maze2d-large").unwrapped
    assert len(large._way_to((1, 1))) == 46, "from everywhere"


def test_another_goal_is_drawn_where_that_is_wanted(tmp_path, capsys):
    path = tmp_path / "a.h5"
    words = ["--env", "maze2d-umaze", "--option", "reset_target=true", "--episodes", "2", "--quiet", "--out", str(path)]
    assert collect_command(words) == 0
    episodes = load_episodes(path)
    assert len(np.unique(episodes.goal, axis=0)) > 6 and episodes.context is None
    reached = np.flatnonzero(np.any(np.diff(episodes.goal, axis=0) != 0, axis=1))
    near = np.linalg.norm(episodes.observations[reached + 1, :2] - episodes.goal[reached], axis=1)
    assert (near[reached + 1 != 300] <= 0.45 + 1e-5).all(), "where the last was reached"
    card = json.loads((tmp_path / "a.card.json").read_text())
    assert set(card["measures"]) == {"score", "success"} and "4 (w - p)" in card["expert"]["law"]
    first = path.read_bytes()
    assert collect_command(words) == 0 and path.read_bytes() == first
    capsys.readouterr()


def test_without_the_extra_the_package_works_and_the_maze_says_what_to_install(tmp_path):
    code = (
        "import sys; sys.modules['gymnasium_robotics'] = None\n"
        "from ada_diffuser import environments\n"
        "environments.make('point-wind-s').reset(seed=0)\n"
        "environments.make(sys.argv[1])\n"
    )
    for name in ("maze2d-umaze", "kitchen-mixed"):
        done = subprocess.run([sys.executable, "-c", code, name], capture_output=True, text=True, cwd=tmp_path, check=False)
        assert "pip install 'ada-diffuser[robotics]'" in done.stderr.splitlines()[-1], done.stderr


def test_the_film_shows_the_maze_and_the_way(tmp_path):
    env = environments.make("maze2d-umaze", render_mode="rgb_array")
    observation, _ = env.reset(seed=4)
    actions = []
    for _ in range(30):
        actions.append(env.unwrapped.expert_action(observation, env.unwrapped.goal).astype(np.float32))
        observation, *_ = env.step(actions[-1])
    frame = env.render()
    assert frame.shape == (200, 200, 3) and (frame[20, 20] == 120).all(), "a wall in the corner"
    x, y = (int(value) for value in env.unwrapped._pixel(observation[:2]))
    assert frame[y, x].tolist() == [30, 90, 180]
    panel = Panel("maze2d-umaze", Episode(4, actions=actions, rewards=[0.0] * 30))
    assert save_film([panel], tmp_path / "film.gif") is None
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 30


# ---- a model that is told the goal ----

SIZES = {"state_dim": 4, "action_dim": 2}
TOLD = {**SIZES, "told": [{"kind": "goal", "columns": [1, 0]}]}
TRIAL = Trial("maze2d-umaze", episodes=3, seed=5, episode_steps=7)


@pytest.fixture
def core() -> Core:
    return Core()


@pytest.fixture(params=["grpc", "http"])
def url(core: Core, request: pytest.FixtureRequest) -> Iterator[str]:
    with serving(core, request.param) as url:
        yield url


def told_goals(core: Core) -> list[list[float] | None]:
    """Of each session that was opened, in the order of opening."""
    found = []
    for options in core.options:
        if isinstance(options, dict):
            found.append(options.get("told_goal"))
        else:
            found.append(list(options.told_goal.values) if options.HasField("told_goal") else None)
    return found


@pytest.mark.parametrize("vector", [1, 2])
def test_each_episode_has_a_session_that_is_told_its_goal_in_the_models_columns(core: Core, url: str, vector: int) -> None:
    core.traits = TOLD
    with Client(url) as client:
        result = evaluate(client, replace(TRIAL, vector=vector))
    goals = []
    for seed in (5, 6, 7):
        env = environments.make("maze2d-umaze")
        env.reset(seed=seed)
        goals.append(env.unwrapped.goal)
    assert np.allclose([episode.goal for episode in result.episodes], goals)
    acted = {name for name, _, _ in core.seen}
    heard = [told for place, told in enumerate(told_goals(core)) if f"s{place}" in acted]
    assert np.allclose(heard, [goal[::-1] for goal in goals], atol=1e-6)
    assert not core.sessions, "each is closed"
    assert result.options.told_goal is None, "no goal is that of all episodes"


def test_a_goal_for_all_episodes_and_a_model_that_takes_none_are_left_as_they_are(core: Core, url: str) -> None:
    with Client(url) as client:
        core.traits = TOLD
        evaluate(client, replace(TRIAL, options=SamplerOptions(told_goal=(0.5, 0.25))))
        assert told_goals(core) == [[0.5, 0.25]]
        core.traits = SIZES
        evaluate(client, TRIAL)
        assert told_goals(core)[1:] == [None]


@pytest.mark.parametrize(
    ("columns", "words", "part"),
    [
        ([0, 3], [], "is told a goal in columns [0, 3] of the state, and maze2d-umaze has one in [0, 1]"),
        ([0, 1], ["--session-episodes", "2"], "cannot follow one another"),
    ],
)
def test_what_does_not_fit_is_said_before_the_first_episode(core: Core, url: str, capsys, columns, words, part) -> None:
    from ada_diffuser.commands.evaluate import main

    core.traits = {**SIZES, "told": [{"kind": "goal", "columns": columns}]}
    assert main(["--env", "maze2d-umaze", "--url", url, "--episodes", "2", *words]) == 1
    error = capsys.readouterr().err
    assert part in error and error.count("\n") == 1 and not core.seen


def test_what_the_maze_says_stands_beside_the_return(core: Core, url: str, tmp_path: Path, capsys) -> None:
    core.traits = TOLD
    words = ["--env", "maze2d-umaze", "--url", url, "--episodes", "3", "--episode-steps", "9"]
    assert rollout_command.main([*words, "--json", str(tmp_path / "a.json"), "--plot", str(tmp_path / "a.png")]) == 0
    table = capsys.readouterr().out
    numbers = json.loads((tmp_path / "a.json").read_text())
    score = numbers["measures"]["score"]
    assert score["values"] == pytest.approx([100 * (value - 23.85) / (161.86 - 23.85) for value in numbers["returns"]], abs=1e-4)
    assert score["mean"] == pytest.approx(np.mean(score["values"]), abs=1e-4)
    assert score["standard_error"] == pytest.approx(np.std(score["values"], ddof=1) / np.sqrt(3), abs=1e-4)
    rows = dict(line.split(maxsplit=1) for line in table.splitlines() if line.startswith(("score", "success")))
    assert rows["score"] == f"{score['mean']:.2f} ± {score['standard_error']:.2f}" and rows["success"].endswith("± 0.00")
    from ada_diffuser.rollout import plot

    plain = tmp_path / "b.png"
    original, plot._draw_ways = plot._draw_ways, lambda axes, readings: False
    try:
        assert rollout_command.main([*words, "--no-table", "--plot", str(plain)]) == 0
    finally:
        plot._draw_ways = original
    assert plain.read_bytes() != (tmp_path / "a.png").read_bytes(), "ways in the place of a context"


TINY = [
    "model.plan.horizon=16",
    "losses.elbo.batch=4",
    "losses.denoise.batch=4",
    "stages.identify.steps=2",
    "stages.identify.learning_rate.warm_up=1",
    "stages.denoise.steps=2",
    "stages.denoise.learning_rate.warm_up=1",
]


def test_the_planner_with_a_goal_is_trained_on_the_mazes_data_and_told_by_the_command(tmp_path: Path, capsys) -> None:
    """Of the recipe and methods that ship; the guidance beyond what is told is refused wherever nothing is."""
    data = tmp_path / "maze.h5"
    assert collect_command(["--env", "maze2d-umaze", "--episodes", "4", "--quiet", "--out", str(data)]) == 0
    recipe = [str(ROOT / "models/maze2d-umaze/recipe.toml"), "--data", str(data), "--out", str(tmp_path / "models/maze")]
    methods = [word for name in ("planner-ii", "told-goal") for word in ("--with", str(ROOT / f"models/methods/{name}.toml"))]
    words = [word for key in TINY for word in ("--set", key)]
    subprocess.run([str(TRAINER), "run", *recipe, *methods, *words], check=True, capture_output=True, cwd=tmp_path, timeout=120)
    with running(tmp_path / "log", "--models", str(tmp_path / "models"), "--default-model", "maze") as address:
        for options in (["free_guidance_scale=1.2"], ["free_guidance_scale=1.2", "told_goal=[1,-1]"]):
            flags = [word for option in ["streaming=false", *options] for word in ("--option", option)]
            where = ["--env", "maze2d-umaze", "--url", address, "--episodes", "2", "--vector", "2", "--episode-steps", "6", "--seed", "5"]
            assert rollout_command.main([*where, *flags, "--no-table", "--json", str(tmp_path / "a.json")]) == 0
            numbers = json.loads((tmp_path / "a.json").read_text())
            assert numbers["options"].get("told_goal") == ([1.0, -1.0] if len(options) > 1 else None)
        with Client(f"grpc://{address}") as client:
            own = evaluate(client, Trial("maze2d-umaze", "maze", 2, 5, options=SamplerOptions(streaming=False), episode_steps=6))
            same = evaluate(client, replace(own.trial, options=SamplerOptions(streaming=False, told_goal=(1.0, -1.0))))
    assert not np.array_equal(own.episodes[0].actions, same.episodes[0].actions), "another goal, another way"
    capsys.readouterr()
