"""What `ada-import` refuses: a line that names the array and the row, exit status 1, and nothing written."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
from formats import KEYS, MAZE, box, d4rl_columns, make_minari, maze_of, minari_buffer, vector_of, write_d4rl, write_robomimic
from trainer import ROWS, STEPS, Arrays, arrays, episodes_of

from ada_diffuser.commands.import_ import main
from ada_diffuser.importing import InvalidData, Request, import_data

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path


@pytest.fixture
def refusal(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """The one line that is said; what lay at `out/x.h5` and its card before is there still, and nothing else."""

    def refused(*words: str) -> str:
        out = Path("out")
        out.mkdir(exist_ok=True)
        for name in ("x.h5", "x.card.json"):
            (out / name).write_text("before")
        assert main([*words, "--out", "out/x.h5", "--quiet"]) == 1
        told = capsys.readouterr()
        assert told.out == "" and told.err.startswith("ada-import: ") and told.err.count("\n") == 1, told
        assert {path.name: path.read_text() for path in out.iterdir()} == {"x.h5": "before", "x.card.json": "before"}
        return told.err

    return refused


def without(*names: str) -> Callable[[Arrays], None]:
    return lambda columns: [columns.pop(name) for name in names] and None


def put(name: str, row: int, value: float, dtype: str = "f4", column: int | None = None) -> Callable[[Arrays], None]:
    def change(columns: Arrays) -> None:
        columns[name] = columns[name].astype(dtype)
        columns[name][row if column is None else (row, column)] = value

    return change


def made(name: str, make: Callable[[np.ndarray], np.ndarray]) -> Callable[[Arrays], None]:
    return lambda columns: columns.update({name: make(columns[name])})


def rolled(columns: Arrays) -> None:
    """Single steps in no order."""
    order = np.random.default_rng(0).permutation(ROWS)
    columns.update({name: values[order] for name, values in columns.items()})


D4RL: dict[str, tuple[Callable[[Arrays], None], list[str], list[str]]] = {
    "no observations": (without("observations", "next_observations"), [], ["`observations`: is missing; the file has actions, infos"]),
    "no actions": (without("actions"), [], ["`actions`: is missing"]),
    "no rewards": (without("rewards"), [], ["`rewards`: is missing", "--reward zero"]),
    "no terminals": (without("terminals"), [], ["`terminals`: is missing"]),
    "no timeouts": (without("timeouts"), [], ["`timeouts`: is missing", "--episode-steps N", "1000"]),
    "two clocks": (lambda columns: None, ["--episode-steps", "24"], ["--episode-steps", "has `timeouts`"]),
    "no clock": (without("timeouts"), ["--episode-steps", "0"], ["--episode-steps must be at least 1"]),
    "nan": (put("observations", 100, np.nan, column=2), [], ["`observations`, row 100: is nan in column 2"]),
    "infinite": (put("actions", 287, -np.inf, column=1), [], ["`actions`, row 287: is -inf in column 1"]),
    "too large": (put("rewards", 5, 1e300, "f8"), [], ["`rewards`, row 5: is 1e+300 and does not fit in 32 bits"]),
    "no flag": (put("terminals", 7, 2, "i8"), [], ["`terminals`, row 7: is 2, and a flag is 0 or 1"]),
    "short": (made("rewards", lambda values: values[:-1]), [], ["`rewards`: has 287 rows, where 288 are expected"]),
    "short flags": (made("timeouts", lambda values: values[:9]), [], ["`timeouts`: has 9 rows, where 288"]),
    "short observations": (made("observations", lambda values: values[:-1]), [], ["`observations`: has 287 rows"]),
    "empty": (lambda columns: columns.update({name: values[:0] for name, values in columns.items()}), [], ["`actions`: has no rows"]),
    "one value": (made("observations", lambda values: np.float32(1)), [], ["`observations`: is one value"]),
    "no columns": (made("observations", lambda values: values[:, :0]), [], ["`observations`: has no columns"]),
    "two rewards": (made("rewards", lambda values: np.column_stack([values, values])), [], ["`rewards`: holds 2 a step"]),
    "matrices": (made("observations", lambda values: values[:, None, :]), [], ["`observations`: holds arrays of 1 x 3 a step"]),
    "images": (
        made("observations", lambda values: np.zeros((ROWS, 4, 4, 3), np.uint8)),
        [],
        ["`observations`: holds images of 4 x 4 x 3 uint8 a step"],
    ),
    "discrete": (
        made("actions", lambda values: values[:, 0].astype(np.int64)),
        [],
        ["`actions`: holds whole numbers (int64)", "one-hot"],
    ),
    "strings": (made("observations", lambda values: values.astype("S4")), [], ["`observations`: holds strings (|S4)"]),
    "complex": (made("actions", lambda values: values.astype("c8")), [], ["`actions`: holds complex numbers (complex64)"]),
    "string rewards": (made("rewards", lambda values: values.astype("S4")), [], ["`rewards`: holds strings (|S4), numbers are expected"]),
    "no such part": (lambda columns: None, ["--observation", "observations,goal"], ["--observation: there is no `goal`", "infos/goal (2)"]),
    "the future": (lambda columns: None, ["--observation", "next_observations"], ["--observation: there is no `next_observations`"]),
    "twice": (lambda columns: None, ["--observation", "infos/goal,infos/goal"], ["`infos/goal` is named twice"]),
    "nothing named": (lambda columns: None, ["--observation", "infos/goal,,"], ["--observation must be names with commas"]),
    "no such context": (lambda columns: None, ["--context", "wind"], ["--context: there is no `wind`"]),
    "a mask": (lambda columns: None, ["--filter", "train"], ["--filter names a mask of a robomimic file"]),
    "another format": (lambda columns: None, ["--format", "robomimic"], ["`data`: is missing; the file has actions, infos"]),
    "in no order": (rolled, [], ["`next_observations`, row", "single steps in no order"]),
    "broken session": (
        lambda columns: columns.update({"infos/session": np.full(ROWS, 0.5)}),
        [],
        ["`infos/session`: holds floats (float64), whole numbers are expected"],
    ),
}


@pytest.mark.parametrize("case", D4RL)
def test_a_d4rl_file_that_is_not_as_it_has_to_be(case: str, refusal: Callable[..., str]) -> None:
    change, flags, words = D4RL[case]
    columns = d4rl_columns()
    change(columns)
    write_d4rl(Path("d4rl.hdf5"), columns)
    told = refusal("d4rl.hdf5", *flags)
    assert all(word in told for word in words), told


def test_arrays_of_another_group_are_pointed_at(refusal: Callable[..., str]) -> None:
    write_d4rl(Path("d4rl.hdf5"), {f"expert/{name}": values for name, values in d4rl_columns().items()})
    assert "of no format that is known" in refusal("d4rl.hdf5") and "`expert/actions`" not in refusal("d4rl.hdf5")
    assert "`expert/observations` is there, but arrays are expected at the root" in refusal("d4rl.hdf5", "--format", "d4rl")


def test_observations_in_groups_are_listed(refusal: Callable[..., str]) -> None:
    columns = d4rl_columns()
    parts = {"observations/arm": columns.pop("observations"), "observations/eye": np.zeros((ROWS, 8, 8, 3), np.uint8)}
    write_d4rl(Path("d4rl.hdf5"), columns | parts)
    told = refusal("d4rl.hdf5")
    assert "--observation KEY[,KEY...] of observations/arm (3), observations/eye (8 x 8 x 3 uint8)" in told
    assert "`observations/eye`: holds images" in refusal("d4rl.hdf5", "--observation", "observations/arm,observations/eye")


def broken_link(file: h5py.File) -> None:
    file["infos/more"] = h5py.SoftLink("/nowhere")


def circle(file: h5py.File) -> None:
    file["infos/more"] = h5py.SoftLink("/infos")


@pytest.mark.parametrize(("change", "words"), [(broken_link, "`infos/more`: is a link to"), (circle, "round in circles")])
def test_links_that_lead_nowhere(change: Callable[[h5py.File], None], words: str, refusal: Callable[..., str]) -> None:
    with h5py.File(write_d4rl(Path("d4rl.hdf5"), d4rl_columns()), "a") as file:
        change(file)
    assert words in refusal("d4rl.hdf5")


def test_half_a_file(refusal: Callable[..., str]) -> None:
    whole = write_d4rl(Path("d4rl.hdf5"), d4rl_columns()).read_bytes()
    Path("d4rl.hdf5").write_bytes(whole[: len(whole) // 2])
    assert "d4rl.hdf5" in refusal("d4rl.hdf5")
    with h5py.File("d4rl.hdf5", "w") as file:
        for name, values in d4rl_columns().items():
            file.create_dataset(name, data=values, chunks=True, fletcher32=True)
        at = file["actions"].id.get_chunk_info(0).byte_offset
    with Path("d4rl.hdf5").open("r+b") as file:
        file.seek(at + 5)
        file.write(b"\xff")
    assert "`actions`: cannot be read" in refusal("d4rl.hdf5")


def demo_of(change: Callable[[h5py.Group], None], demo: str = "data/demo_3") -> Callable[[h5py.File], None]:
    return lambda file: change(file[demo])


def replaced(name: str, values: Any) -> Callable[[h5py.Group], None]:
    def change(group: h5py.Group) -> None:
        made = values(group[name][()]) if callable(values) else values
        del group[name]
        group[name] = made

    return change


def ragged(group: h5py.Group) -> None:
    del group["obs/object"]
    lists = group.create_dataset("obs/object", STEPS, h5py.vlen_dtype(np.float64))
    for row in range(STEPS):
        lists[row] = np.zeros(1 + row % 2)


def at(row: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(values: np.ndarray) -> np.ndarray:
        values = values.astype(np.float64)
        values[row] = value
        return values

    return change


PICK = ["--observation", KEYS]
ROBOMIMIC: dict[str, tuple[Callable[[h5py.File], Any], list[str], list[str]]] = {
    "parts": (
        lambda file: None,
        [],
        ["`data/demo_0/observations`: have several parts", "--observation KEY", "object (1), robot0_eef_pos (1)", "8 x 8 x 3 uint8"],
    ),
    "images": (lambda file: None, ["--observation", "agentview_image"], ["`data/demo_0/obs/agentview_image`: holds images of 8 x 8 x 3"]),
    "no such part": (lambda file: None, ["--observation", "object,gripper"], ["--observation: there is no `gripper`", "object (1)"]),
    "missing further on": (
        demo_of(lambda demo: demo.pop("obs/object")),
        PICK,
        ["`data/demo_3`: has no `object`, as `data/demo_0/obs/object` was; it has"],
    ),
    "another width": (
        demo_of(replaced("obs/object", lambda values: np.hstack([values, values]))),
        PICK,
        ["`data/demo_3/obs/object`: has 2 columns, but `data/demo_0/obs/object` has 1"],
    ),
    "another length": (
        demo_of(replaced("obs/object", lambda values: values[:-2])),
        PICK,
        ["`data/demo_3/obs/object`: has 22 rows, where 24"],
    ),
    "ragged": (demo_of(ragged), PICK, ["`data/demo_3/obs/object`: holds strings, or lists of their own length each"]),
    "nan": (demo_of(replaced("obs/object", at(13, np.nan))), PICK, ["`data/demo_3/obs/object`, row 13: is nan in column 0"]),
    "no actions": (demo_of(lambda demo: demo.pop("actions")), PICK, ["`data/demo_3/actions`: is missing; the demonstration has dones"]),
    "other actions": (
        demo_of(replaced("actions", lambda values: values[:, :1])),
        PICK,
        ["`data/demo_3/actions`: has 1 columns, but `data/demo_0/actions` has 2"],
    ),
    "no rewards": (demo_of(lambda demo: demo.pop("rewards")), PICK, ["`data/demo_3/rewards`: is missing", "--reward zero"]),
    "other count": (
        demo_of(lambda demo: demo.attrs.modify("num_samples", 57)),
        PICK,
        ["`data/demo_3/actions`: has 24 rows, but the attribute `num_samples` says 57"],
    ),
    "no steps": (
        demo_of(lambda demo: [replaced("actions", np.zeros((0, 2)))(demo), demo.attrs.modify("num_samples", 0)]),
        PICK,
        ["`data/demo_3/actions`: has no rows"],
    ),
    "odd done": (demo_of(replaced("dones", at(4, 3))), PICK, ["`data/demo_3/dones`, row 4: is 3, and a flag is 0 or 1"]),
    "raw": (
        lambda file: [demo.pop("obs") for demo in file["data"].values()],
        [],
        ["`data/demo_0`: has no observations", "states (3)", "dataset_states_to_obs.py"],
    ),
    "no such mask": (lambda file: None, [*PICK, "--filter", "valid"], ["--filter valid: there is no such mask; the file has empty, train"]),
    "an empty mask": (lambda file: None, [*PICK, "--filter", "empty"], ["`mask/empty`: names no demonstrations"]),
    "a mask of what is gone": (
        lambda file: file["data"].pop("demo_10"),
        [*PICK, "--filter", "train"],
        ["`mask/train`, row 2: names demo_10, which is not in `data`"],
    ),
    "a clock": (lambda file: None, [*PICK, "--episode-steps", "24"], ["--episode-steps is for D4RL files"]),
    "no demonstrations": (lambda file: file["data"].clear(), [*PICK, "--format", "robomimic"], ["`data`: has no demonstrations"]),
}


@pytest.mark.parametrize("case", ROBOMIMIC)
def test_a_robomimic_file_that_is_not_as_it_has_to_be(case: str, refusal: Callable[..., str]) -> None:
    change, flags, words = ROBOMIMIC[case]
    with h5py.File(write_robomimic(Path("low_dim.hdf5")), "a") as file:
        change(file)
    told = refusal("low_dim.hdf5", *flags)
    assert all(word in told for word in words), told


def buffers(observe: Callable[[Arrays], Any] = vector_of, **changes: Any) -> list:
    """The small data set, whose fourth episode is different."""
    made = [minari_buffer(steps, observe(steps)) for steps in episodes_of(arrays())]
    steps = episodes_of(arrays())[3]
    made[3] = minari_buffer(steps, changes.pop("observations", observe(steps)), **changes)
    return made


def test_a_maze_of_minari_lists_its_parts(refusal: Callable[..., str]) -> None:
    make_minari("maze-v0", buffers(maze_of), MAZE)
    told = refusal("maze-v0")
    assert "`episode_0/observations`: have several parts" in told
    assert "--observation KEY[,KEY...] of achieved_goal (2), desired_goal (1), observation (2)" in told


MINARI: dict[str, tuple[dict[str, Any], list[str]]] = {
    "nan": ({"rewards": [0.0] * 5 + [np.nan] + [0.0] * 18}, ["`episode_3/rewards`, row 5: is nan"]),
    "one observation too few": ({"observations": [np.zeros(3)] * STEPS}, ["`episode_3/observations`: has 24 rows, where 25 are expected"]),
    "short actions": ({"actions": [np.zeros(2)] * 9}, ["`episode_3/actions`: has 9 rows, where 24"]),
    "short flags": ({"truncations": [False] * 9}, ["`episode_3/truncations`: has 9 rows, where 24"]),
    "other actions": ({"actions": [np.zeros(5)] * STEPS}, ["`episode_3/actions`: has 5 columns, but `episode_0/actions` has 2"]),
    "infinite": (
        {"observations": [np.zeros(3)] * 24 + [np.full(3, np.inf)], "actions": [np.full(2, np.inf)] * STEPS},
        ["`episode_3/actions`, row 0: is inf in column 0"],
    ),
}


@pytest.mark.parametrize("case", MINARI)
def test_a_minari_data_set_that_is_not_as_it_has_to_be(case: str, refusal: Callable[..., str]) -> None:
    changes, words = MINARI[case]
    make_minari("hopper-v0", buffers(**changes), box(3))
    told = refusal("hopper-v0")
    assert all(word in told for word in words), told


def test_what_nobody_sees_of_minari_may_be_anything() -> None:
    """The observation after the last step is no row of the trainer's."""
    make_minari("hopper-v0", buffers(observations=[np.zeros(3)] * STEPS + [np.full(3, np.inf)]), box(3))
    assert main(["hopper-v0", "--out", "x.h5", "--quiet"]) == 0


def test_minari_of_whole_numbers_and_of_parts(refusal: Callable[..., str]) -> None:
    steps = [np.int64(1)] * STEPS
    make_minari("bandit-v0", [minari_buffer(episodes_of(arrays())[0], [*steps, steps[0]])], gymnasium.spaces.Discrete(3))
    assert "`episode_0/observations`: holds whole numbers (int64)" in refusal("bandit-v0")
    parts = gymnasium.spaces.Dict({"arm": box(1), "hand": box(1)})
    actions = {name: [np.zeros(1)] * STEPS for name in ("arm", "hand")}
    episode = episodes_of(arrays())[0]
    make_minari("parts-v0", [minari_buffer(episode, vector_of(episode), actions=actions)], box(3), parts)
    assert "`episode_0/actions`: has the parts arm, hand: actions are one vector here" in refusal("parts-v0")


def test_a_broken_minari_data_set(refusal: Callable[..., str]) -> None:
    folder = make_minari("hopper-v0", buffers(), box(3)) / "data"
    told = json.loads((folder / "metadata.json").read_text())
    for count in (ROWS - 1, ROWS + 1):
        (folder / "metadata.json").write_text(json.dumps(told | {"total_steps": count}))
        assert f"says `total_steps` {count}, but the episodes have {ROWS} together" in refusal("hopper-v0")
    (folder / "metadata.json").write_text(json.dumps(told | {"minari_version": "9.9.9"}))
    assert "cannot be read by minari" in refusal("hopper-v0") and "9.9.9" in refusal("hopper-v0")
    (folder / "metadata.json").write_text(json.dumps(told))
    with h5py.File(folder / "main_data.hdf5", "a") as file:
        del file["episode_7/rewards"]
    told = refusal("hopper-v0")
    assert "`episode_7`: cannot be read by minari" in told and "rewards" in told
    (folder / "metadata.json").unlink()
    assert "metadata.json is not beside it" in refusal(str(folder / "main_data.hdf5"))
    assert "a folder without data/metadata.json" in refusal(str(folder))


def test_what_is_no_source_at_all(refusal: Callable[..., str]) -> None:
    Path("x.npz").write_bytes(b"PK\x03\x04 and so on")
    assert "x.npz is no HDF5 file" in refusal("x.npz")
    assert "nothing.hdf5 is not there" in refusal("nothing.hdf5")
    told = refusal("D4RL/pointmaze/umaze-v2")
    assert (
        "there is no Minari data set D4RL/pointmaze/umaze-v2 on this machine" in told and "minari download D4RL/pointmaze/umaze-v2" in told
    )
    with h5py.File("other.h5", "w") as file:
        file["states"] = np.zeros(3)
    assert "of no format that is known" in refusal("other.h5") and "at its root are states" in refusal("other.h5")
    write_d4rl(Path("out.h5"), d4rl_columns())
    before = Path("out.h5").read_bytes()
    assert main(["out.h5", "--out", "out.h5"]) == 1 and Path("out.h5").read_bytes() == before


def test_an_error_says_its_key_and_row_to_programs_too() -> None:
    columns = d4rl_columns()
    columns["actions"][17, 1] = np.nan
    write_d4rl(Path("d4rl.hdf5"), columns)
    with pytest.raises(InvalidData) as caught:
        import_data(Request("d4rl.hdf5"), Path("x.h5"))
    assert (caught.value.key, caught.value.row) == ("actions", 17) and "nan" in caught.value.why


def test_an_import_that_is_stopped_leaves_nothing() -> None:
    """Ctrl-C in the midst of writing."""
    rows = 6_000_000
    with h5py.File("large.hdf5", "w") as file:
        for name, width in (("observations", 20), ("actions", 2)):
            file.create_dataset(name, (rows, width), "f4")
        file.create_dataset("rewards", (rows,), "f4")
        for name in ("terminals", "timeouts"):
            file.create_dataset(name, (rows,), "?")
    command = [sys.executable, "-m", "ada_diffuser.commands.import_", "large.hdf5", "--out", "out/x.h5"]
    # A shell's background job is deaf to it, and so would be what it starts.
    heard = signal.signal(signal.SIGINT, signal.SIG_DFL)
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"})
    signal.signal(signal.SIGINT, heard)
    while run.poll() is None and not Path("out/.x.h5.partial").exists():
        time.sleep(0.01)
    run.send_signal(signal.SIGINT)
    assert run.wait(60) == 130 and "ada-import: interrupted" in run.stderr.read()
    assert list(Path("out").iterdir()) == []
