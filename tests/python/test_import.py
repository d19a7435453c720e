"""`ada-import` takes real files of others as they are: every number comes through, and the trainer learns from what is written."""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from formats import (
    ENV_ARGS,
    KEYS,
    MAZE,
    WIDTHS,
    box,
    d4rl_columns,
    make_minari,
    maze_of,
    minari_buffer,
    vector_of,
    write_d4rl,
    write_robomimic,
)
from trainer import EPISODES, ROOT, ROWS, STEPS, arrays, episodes_of, log, write

from ada_diffuser.commands.collect import main as collect
from ada_diffuser.commands.import_ import main
from ada_diffuser.dataset import Episodes, card_path, load_episodes, save_episodes, sha256, writing_episodes
from ada_diffuser.importing import Request, d4rl, import_data
from ada_diffuser.importing.columns import leaves

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path


@pytest.fixture(scope="module")
def blind(tmp_path_factory) -> str:
    """The trainer's log of the plain file without context: of the same numbers it says the same, digit by digit."""
    folder = tmp_path_factory.mktemp("blind")
    columns = arrays()
    del columns["infos/context"]
    return log(write(folder / "blind.h5", columns), folder / "out")


def imported(*words: str, out: str = "x.h5") -> Episodes:
    assert main([*words, "--out", out, "--quiet"]) == 0
    return load_episodes(Path(out))


def everything(path: Path) -> dict[str, np.ndarray]:
    with h5py.File(path) as file:
        return {name: array[()] for name, array in leaves(file)}


def card(out: str = "x.h5") -> dict:
    return json.loads(card_path(Path(out)).read_text())


def assert_same(episodes: Episodes, *, context: bool = False) -> None:
    """All numbers of the small data set, in its order, bit for bit."""
    columns = arrays()
    for name, field in (("observations", "observations"), ("actions", "actions"), ("rewards", "rewards")):
        values = getattr(episodes, field)
        assert values.dtype == np.float32 and np.array_equal(values, columns[name]), name
    assert np.array_equal(episodes.terminals, columns["terminals"]) and np.array_equal(episodes.timeouts, columns["timeouts"])
    assert (episodes.context is not None) == context
    assert not context or np.array_equal(episodes.context, columns["infos/context"])


def test_a_d4rl_file_comes_through_and_the_card_says_what_it_is(blind: str, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_d4rl(Path("hopper.hdf5"), d4rl_columns())
    assert_same(imported("hopper.hdf5"))
    told = capsys.readouterr().out
    assert "x.h5: 12 episodes of 24 steps, 288 steps; return " in told and "observations: 3" in told and "x.card.json" in told
    assert log(Path("x.h5"), Path("out")) == blind
    assert log(source, Path("as-it-is")) == blind, "the trainer reads such a file itself, and sees the same"
    found = card()
    assert found["imported"] == {"format": "d4rl", "name": source.name, "sha256": sha256(source), "bytes": source.stat().st_size}
    assert found["file"]["sha256"] == hashlib.sha256(Path("x.h5").read_bytes()).hexdigest()
    assert (found["episodes"], found["steps"], found["notes"]) == (EPISODES, ROWS, [])
    assert found["lengths"] == {"median": STEPS, "min": STEPS, "max": STEPS}
    returns = arrays()["rewards"].reshape(EPISODES, STEPS).sum(axis=1)
    assert found["returns"]["mean"] == pytest.approx(returns.mean(), abs=1e-3) and "failures" not in found["returns"]
    assert found["observations"] == [{"name": "observations", "width": 3, "columns": [0, 3]}]
    assert found["left_out"] == ["infos/action_log_probs", "infos/goal", "infos/qpos"]
    assert "minari" not in found["versions"] and found["command"] == "ada-import hopper.hdf5 --out x.h5 --quiet"


def test_the_card_is_printed_for_scripts(capsys: pytest.CaptureFixture[str]) -> None:
    write_d4rl(Path("hopper.hdf5"), d4rl_columns())
    imported("hopper.hdf5", "--json")
    assert json.loads(capsys.readouterr().out) == card()


def test_the_same_source_gives_the_same_bytes_in_however_many_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    write_d4rl(Path("hopper.hdf5"), d4rl_columns())
    imported("hopper.hdf5", out="whole.h5")
    monkeypatch.setattr(d4rl, "PIECE_ROWS", 7)
    imported("hopper.hdf5", out="pieces.h5")
    assert Path("whole.h5").read_bytes() == Path("pieces.h5").read_bytes()


def test_a_file_of_pieces_is_a_file_of_one() -> None:
    columns = arrays()
    fields = {name: columns[name] for name in ("observations", "actions", "rewards", "terminals", "timeouts")}
    digest = save_episodes(Episodes(**fields, context=columns["infos/context"]), Path("one.h5"))
    with writing_episodes(Path("many.h5"), ROWS) as append:
        for steps in episodes_of(columns):
            append(Episodes(**{name: steps[name] for name in fields}, context=steps["infos/context"]))
    assert sha256(Path("many.h5")) == digest
    with pytest.raises(ValueError, match="24 of 288"), writing_episodes(Path("many.h5"), ROWS) as append:
        append(Episodes(**{name: values[:STEPS] for name, values in fields.items()}))
    assert sha256(Path("many.h5")) == digest and sorted(path.name for path in Path().iterdir()) == ["many.h5", "one.h5"]


def test_the_clock_of_old_files_is_said(blind: str) -> None:
    """D4RL's first files have terminals alone; the clock runs from each episode's own first step."""
    columns = d4rl_columns()
    del columns["timeouts"]
    write_d4rl(Path("old.hdf5"), columns)
    episodes = imported("old.hdf5", "--episode-steps", str(STEPS))
    assert_same(episodes)
    assert log(Path("x.h5"), Path("out")) == blind
    assert card()["notes"] == [f"no timeouts in the source: episodes end by `terminals`, or after {STEPS} steps"]
    columns["terminals"][:] = np.isin(np.arange(ROWS), [4, 40])
    write_d4rl(Path("old.hdf5"), columns)
    ends = imported("old.hdf5", "--episode-steps", "100")
    assert np.flatnonzero(ends.terminals).tolist() == [4, 40] and np.flatnonzero(ends.timeouts).tolist() == [140, 240, ROWS - 1]
    assert "the recording stops within the last episode" in card()["notes"][1]


def test_goals_are_shown_or_hidden_as_told() -> None:
    columns = d4rl_columns()
    write_d4rl(Path("maze.hdf5"), columns)
    episodes = imported("maze.hdf5", "--observation", "observations,infos/goal")
    assert np.array_equal(episodes.observations, np.hstack([columns["observations"], columns["infos/goal"]]))
    assert card()["observations"] == [
        {"name": "observations", "width": 3, "columns": [0, 3]},
        {"name": "infos/goal", "width": 2, "columns": [3, 5]},
    ]
    assert "infos/goal" not in card()["left_out"]
    episodes = imported("maze.hdf5", "--context", "infos/goal,infos/action_log_probs")
    expected = np.column_stack([columns["infos/goal"], columns["infos/action_log_probs"]])
    assert np.array_equal(episodes.context, expected) and [part["width"] for part in card()["context"]] == [2, 1]


def test_glued_episodes_are_found_by_their_next_observations() -> None:
    columns = d4rl_columns()
    columns["timeouts"][2 * STEPS - 1] = False
    write_d4rl(Path("glued.hdf5"), columns)
    imported("glued.hdf5")
    (note,) = card()["notes"]
    assert f"at 1 rows that end no episode, the first of them row {2 * STEPS - 1}" in note
    assert card()["lengths"]["max"] == 2 * STEPS


def test_goals_held_are_single_steps_and_said_to_be() -> None:
    columns = d4rl_columns()
    columns["terminals"][10:15] = True
    del columns["next_observations"]
    write_d4rl(Path("held.hdf5"), columns)
    assert len(imported("held.hdf5").returns()) == EPISODES + 5
    assert card()["notes"] == ["`terminals` is true in 4 step(s) right after an episode's end: each is an episode of one step"]


def test_a_file_of_ada_collect_is_what_it_was_and_others_join_it() -> None:
    flags = ["--env", "point-wind-s", "--episodes", "4", "--session-episodes", "2", "--play", "0.5", "--quiet"]
    assert collect([*flags, "--out", "own.h5"]) == 0
    imported("own.h5")
    own, other = (everything(Path(name)) for name in ("own.h5", "x.h5"))
    assert list(own) == list(other) and {"infos/context", "infos/action_noise", "infos/play", "infos/session"} < set(own)
    for name, values in own.items():
        assert values.dtype == other[name].dtype and np.array_equal(values, other[name]), name
    columns = {name: values for name, values in d4rl_columns().items() if not name.startswith("infos")}
    columns["observations"] = np.hstack([columns["observations"], columns["rewards"][:, None]])
    del columns["next_observations"]
    write_d4rl(Path("other.hdf5"), columns | {"infos/context": columns["actions"]})
    imported("other.hdf5", out="other.h5")
    assert collect(["--env", "point-wind-s", "--episodes", "2", "--quiet", "--also", "other.h5", "--out", "both.h5"]) == 0
    both = load_episodes(Path("both.h5"))
    assert len(both.returns()) == 2 + EPISODES and both.action_noise is None, "nobody knows the noise of a stranger's data"


@pytest.mark.parametrize("where", ["id", "folder", "data", "file"])
def test_a_minari_data_set_is_found_by_id_and_by_path(where: str) -> None:
    buffers = [minari_buffer(steps, vector_of(steps)) for steps in episodes_of(arrays())]
    folder = make_minari("mine/hopper/expert-v3", buffers, box(3))
    source = {"id": "mine/hopper/expert-v3", "folder": folder, "data": folder / "data", "file": folder / "data/main_data.hdf5"}[where]
    assert_same(imported(str(source)), context=True)
    found = card()
    assert (found["imported"]["format"], found["imported"]["name"]) == ("minari", "mine/hopper/expert-v3")
    assert found["environment"]["id"] == "Pendulum-v1" and "minari" in found["versions"]
    lines = "".join(f"{sha256(folder / 'data' / name)}  {name}\n" for name in ("main_data.hdf5", "metadata.json"))
    assert found["imported"]["sha256"] == hashlib.sha256(lines.encode()).hexdigest()


def test_a_minari_data_set_trains(blind: str) -> None:
    buffers = [minari_buffer(steps, vector_of(steps), infos=None) for steps in episodes_of(arrays())]
    make_minari("hopper-v0", buffers, box(3))
    assert_same(imported("hopper-v0"))
    assert log(Path("x.h5"), Path("out")) == blind


def test_a_maze_of_minari_shows_the_parts_that_are_named(blind: str) -> None:
    make_minari("maze-v0", [minari_buffer(steps, maze_of(steps)) for steps in episodes_of(arrays())], MAZE)
    assert_same(imported("maze-v0", "--observation", "observation,desired_goal"), context=True)
    assert [(part["name"], part["columns"]) for part in card()["observations"]] == [("observation", [0, 2]), ("desired_goal", [2, 3])]
    assert card()["left_out"] == ["achieved_goal", "infos/goal/xy"]
    turned = imported("maze-v0", "--observation", "desired_goal,achieved_goal", "--context", "infos/goal/xy")
    columns = arrays()
    assert np.array_equal(turned.observations, np.hstack([columns["observations"][:, 2:], columns["observations"][:, :2] + 0.5]))
    assert np.array_equal(turned.context, np.repeat(columns["infos/context"], 2, axis=1)), "as told when the step was made"


def test_a_robomimic_file_comes_through_in_the_order_of_its_numbers(blind: str, capsys: pytest.CaptureFixture[str]) -> None:
    """By name demo_10 comes before demo_2."""
    write_robomimic(Path("low_dim.hdf5"))
    assert_same(imported("low_dim.hdf5", "--observation", KEYS))
    assert "observations: robot0_eef_pos 1, robot0_gripper_qpos 1, object 1: 3" in capsys.readouterr().out
    assert log(Path("x.h5"), Path("out")) == blind
    found = card()
    assert found["environment"] == {"id": "Lift", "options": ENV_ARGS["env_kwargs"]} and found["imported"]["format"] == "robomimic"
    assert found["left_out"] == ["states", "agentview_image"]
    assert [part["name"] for part in found["observations"]] == list(WIDTHS)


def test_a_mask_chooses_demonstrations() -> None:
    write_robomimic(Path("low_dim.hdf5"))
    episodes = imported("low_dim.hdf5", "--observation", KEYS, "--filter", "train")
    chosen = [episodes_of(arrays())[index]["observations"] for index in (0, 2, 10, 11)]
    assert np.array_equal(episodes.observations, np.vstack(chosen)) and card()["imported"]["filter"] == "train"


def test_a_demonstration_ends_at_its_last_step_alone() -> None:
    """`dones` tells success in some of robomimic's files: whoever cuts there makes many episodes of one."""
    write_robomimic(Path("low_dim.hdf5"))
    with h5py.File("low_dim.hdf5", "a") as file:
        file["data/demo_11/dones"][-5:] = 1
        del file["data/demo_3/dones"]
    assert_same(imported("low_dim.hdf5", "--observation", KEYS))
    assert card()["notes"] == [
        "1 demonstration(s) have `dones` before their last step, and were not cut there",
        "6 demonstration(s) end without `dones`: their last step counts as a timeout",
    ]


def test_a_raw_file_has_its_states_and_libero_its_flags_for_rewards() -> None:
    write_robomimic(Path("demo.hdf5"), raw=True)
    with h5py.File("demo.hdf5", "a") as file:
        for demo in file["data"].values():
            success = demo["rewards"][()] > 25
            del demo["rewards"]
            demo["rewards"] = success.astype(np.uint8)
    episodes = imported("demo.hdf5", "--observation", "states")
    assert np.array_equal(episodes.observations, arrays()["observations"])
    assert np.array_equal(episodes.rewards, arrays()["rewards"] > 25)
    with h5py.File("demo.hdf5", "a") as file:
        for demo in file["data"].values():
            del demo["rewards"]
    assert not imported("demo.hdf5", "--observation", "states", "--reward", "zero").rewards.any()
    assert "rewards are zeros: --reward zero" in card()["notes"]


@pytest.mark.parametrize(
    ("document", "title", "count"), [("clients/python/README.md", "Data of others", 5), ("docs/data.md", "From other layouts", 2)]
)
def test_what_the_documents_show_is_what_works(document: str, title: str, count: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Every line of the first block under the title, on files of those names."""
    columns = d4rl_columns()
    for name in ("halfcheetah_medium-v2.hdf5", "maze2d-umaze-sparse-v1.hdf5"):
        write_d4rl(Path(name), columns)
    write_d4rl(Path("hopper_mixed.hdf5"), {name: values for name, values in columns.items() if name != "timeouts"})
    make_minari("D4RL/pointmaze/umaze-v2", [minari_buffer(steps, maze_of(steps)) for steps in episodes_of(arrays())], MAZE)
    with h5py.File(write_robomimic(Path("low_dim_v141.hdf5")), "a") as file:
        for demo in file["data"].values():
            demo["obs/robot0_eef_quat"] = demo["obs/object"][()]
    section = (ROOT / document).read_text(encoding="utf-8").split(f"# {title}\n")[1]
    lines = section.split("```sh\n")[1].split("```")[0].replace("\\\n", " ").splitlines()
    assert len(lines) == count
    for line in lines:
        program, *words = shlex.split(line, comments=True)
        assert program == "ada-import" and main([*words, "--quiet"]) == 0, (line, capsys.readouterr().err)


def test_python_is_given_the_card() -> None:
    write_robomimic(Path("low_dim.hdf5"))
    request = Request("low_dim.hdf5", observation=("object",), filter="train")
    assert import_data(request, Path("x.h5"))["steps"] == 4 * STEPS and card()["command"] == ""
    with pytest.raises(ValueError, match="none of d4rl"):
        import_data(Request("low_dim.hdf5", format="npz"), Path("x.h5"))


def test_help_needs_no_library_and_a_run_says_what_to_install(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    buffers = [minari_buffer(steps, vector_of(steps)) for steps in episodes_of(arrays())]
    make_minari("hopper-v0", buffers, box(3))
    monkeypatch.setitem(sys.modules, "minari", None)
    monkeypatch.delitem(sys.modules, "ada_diffuser.importing.minari_set", raising=False)
    assert main(["hopper-v0", "--out", "x.h5"]) == 1
    assert "pip install 'ada-diffuser[import]'" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "maze2d" in capsys.readouterr().out
