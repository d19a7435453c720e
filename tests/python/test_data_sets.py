"""Whatever h5py can store a data set as, the trainer reads as h5py does, or refuses by name."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from trainer import EPISODES, RECIPE, ROOT, ROWS, STEPS, TRAINER, Arrays, arrays, episodes_of, log, train, write


def refusal(data: Path, out: Path) -> str:
    done = train(data, out, "--set", "stages.identify.steps=2", "--set", "stages.denoise.steps=2")
    assert done.returncode == 1, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: data set ") and data.name in lines[0], done.stderr
    return lines[0]


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> str:
    """The log of the plain file, which every other way to store the same numbers must repeat."""
    folder = tmp_path_factory.mktemp("plain")
    return log(write(folder / "plain.h5", arrays()), folder / "out")


DTYPES = ["<f2", ">f2", "<f4", ">f4", "<f8", ">f8", "i1", "u1", "<i2", ">i2", "<u2", "<i4", ">u4", "<i8", ">i8", "<u8"]
PLAIN: dict[str, Any] = {}
CHUNKED = {"chunks": True}
GZIP = {"compression": "gzip"}
LZF = {"compression": "lzf"}
ALL = {"compression": "lzf", "shuffle": True, "fletcher32": True}


@pytest.mark.parametrize("how", [PLAIN, GZIP, ALL], ids=["plain", "gzip", "lzf+shuffle+fletcher32"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_every_number_is_read_as_h5py_reads_it(dtype, how, plain, tmp_path):
    """float16 and integers were refused, LZF too; big endian and odd sizes must not be taken for something else."""
    columns = arrays()
    numbers = {name: values.astype(dtype) for name, values in columns.items() if values.dtype != bool}
    assert log(write(tmp_path / "x.h5", columns | numbers, **how), tmp_path / "out") == plain


@pytest.mark.parametrize("dtype", ["bool", "u1", "i1", "<i8", "<f4", ">f8"])
def test_flags_of_every_type(dtype, plain, tmp_path):
    columns = arrays()
    flags = {name: values.astype(dtype) for name, values in columns.items() if values.dtype == bool}
    assert log(write(tmp_path / "x.h5", columns | flags), tmp_path / "out") == plain


LAYOUTS: dict[str, dict[str, Any]] = {
    "chunked": CHUNKED,
    "shuffle": {"shuffle": True, "chunks": True},
    "fletcher32": {"fletcher32": True},
    "lzf": LZF,
    "gzip+shuffle": GZIP | {"shuffle": True},
    "gzip9+fletcher32": {"compression": "gzip", "compression_opts": 9, "fletcher32": True},
    "scaleoffset": {"scaleoffset": 0},
    "scaleoffset+gzip": GZIP | {"scaleoffset": 0},
    "szip": {"compression": "szip"},
}


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_and_filter(layout, libver, plain, tmp_path):
    how = LAYOUTS[layout]
    if layout == "szip" and not h5py.h5z.filter_avail(h5py.h5z.FILTER_SZIP):
        pytest.skip("this h5py cannot write szip")
    columns: Arrays = {name: values.astype(np.int32) if "scaleoffset" in how else values for name, values in arrays().items()}
    assert log(write(tmp_path / "x.h5", columns, libver, **how), tmp_path / "out") == plain


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("chunk", [1, 7, 24, ROWS, 1000])
@pytest.mark.parametrize("grows", ["not", "rows", "both"])
def test_every_shape_of_chunks(chunk, grows, libver, plain, tmp_path):
    """Chunk indices differ with what may grow: fixed and extensible arrays, trees of both versions, a single chunk."""
    with h5py.File(tmp_path / "x.h5", "w", libver=libver) as file:
        for name, values in arrays().items():
            limits = {"not": values.shape, "rows": (None, *values.shape[1:]), "both": (None,) * values.ndim}[grows]
            rows = min(chunk, ROWS) if grows == "not" else chunk
            chunks = (rows,) if values.ndim == 1 else (rows, 1 if chunk == 7 else values.shape[1])
            file.create_dataset(name, data=values, chunks=chunks, maxshape=limits, compression="gzip" if chunk == 24 else None)
    assert log(tmp_path / "x.h5", tmp_path / "out") == plain


@pytest.mark.parametrize("dtype", ["<f4", ">f8"])
def test_numbers_that_the_filter_rounds(dtype, tmp_path):
    """Scale-offset keeps so many digits: what h5py reads then is the truth."""
    rng = np.random.default_rng(1)
    columns = arrays()
    rounded = {name: rng.normal(size=values.shape).astype(dtype) for name, values in columns.items() if values.dtype != bool}
    for name in rounded:
        del columns[name]
    path = write(tmp_path / "x.h5", rounded, scaleoffset=3)
    with h5py.File(path, "a") as file:
        for name, values in columns.items():
            file[name] = values
        columns |= {name: file[name][()] for name in rounded}
    assert np.abs(columns["actions"] - rounded["actions"]).max() > 1e-6, "the filter rounds"
    assert log(path, tmp_path / "a") == log(write(tmp_path / "plain.h5", columns), tmp_path / "b")


def test_what_was_never_written_is_the_fill_value(tmp_path):
    columns = arrays()
    columns["actions"][100:200] = 0.5
    columns["rewards"][:] = 3.0
    expected = log(write(tmp_path / "full.h5", columns), tmp_path / "a")
    actions, rewards = columns.pop("actions"), columns.pop("rewards")
    write(tmp_path / "holes.h5", columns)
    with h5py.File(tmp_path / "holes.h5", "a") as file:
        sparse = file.create_dataset("actions", actions.shape, "<f4", chunks=(50, 2), fillvalue=0.5)
        sparse[:100], sparse[200:] = actions[:100], actions[200:]
        file.create_dataset("rewards", rewards.shape, ">f8", fillvalue=3.0)
    assert log(tmp_path / "holes.h5", tmp_path / "b") == expected


def other_file(path: Path) -> Path:
    return write(path.with_name("other.h5"), arrays())


def soft_nowhere(file: h5py.File, name: str) -> None:
    file[name] = h5py.SoftLink("/nowhere")


def external(file: h5py.File, name: str) -> None:
    file[name] = h5py.ExternalLink("other.h5", name)


def external_nowhere(file: h5py.File, name: str) -> None:
    file[name] = h5py.ExternalLink("nowhere.h5", name)


def group(file: h5py.File, name: str) -> None:
    file.create_group(name)


def named_type(file: h5py.File, name: str) -> None:
    file[name] = np.dtype("f4")


def virtual(file: h5py.File, name: str) -> None:
    values = arrays()[name]
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[...] = h5py.VirtualSource("other.h5", name, values.shape)
    file.create_virtual_dataset(name, layout)


def elsewhere(file: h5py.File, name: str) -> None:
    raw = Path(file.filename).with_name("raw.bin")
    raw.write_bytes(b"\1" * 10_000)
    file.create_dataset(name, arrays()[name].shape, "f4", external=[(str(raw), 0, h5py.h5f.UNLIMITED)])


def empty(file: h5py.File, name: str) -> None:
    file[name] = h5py.Empty("f4")


def scalar(file: h5py.File, name: str) -> None:
    file[name] = np.float32(1)


def damaged(file: h5py.File, name: str) -> None:
    file.create_dataset(name, data=arrays()[name])
    where = h5py.h5o.get_info(file[name].id).addr
    path = file.filename
    file.close()
    with open(path, "r+b") as raw:
        raw.seek(where)
        raw.write(b"\xff" * 24)


UNREADABLE: dict[Callable[[h5py.File, str], None], str] = {
    soft_nowhere: "is a link to `/nowhere`, which cannot be opened",
    external: "in another file, other.h5; copy it into this one",
    external_nowhere: "in another file, nowhere.h5; copy it into this one",
    group: "is a group, expected an array",
    named_type: "is there, but is no array",
    virtual: "a virtual data set",
    elsewhere: "has its values in other files",
    empty: "shape []",
    scalar: "shape []",
    damaged: "is there, but cannot be read",
}


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("name", ["timeouts", "infos/context", "terminals", "observations", "actions"])
@pytest.mark.parametrize("how", UNREADABLE, ids=lambda how: how.__name__)
def test_present_but_unreadable_is_an_error(how, name, libver, tmp_path):
    """`timeouts` that could not be opened counted as absent: episodes were glued together without a word."""
    other_file(tmp_path / "x.h5")
    columns = arrays()
    del columns[name]
    path = write(tmp_path / "x.h5", columns, libver)
    with h5py.File(path, "a", libver=libver) as file:
        how(file, name)
    error = refusal(path, tmp_path / "out")
    assert f"`{name}`" in error and UNREADABLE[how] in error, error


def test_links_are_found_among_many_names(tmp_path):
    """Many names of one group lie in a heap of their own."""
    columns = arrays()
    del columns["timeouts"]
    path = write(tmp_path / "x.h5", columns | {f"extra_{i}": np.zeros(3) for i in range(40)}, "latest")
    with h5py.File(path, "a", libver="latest") as file:
        soft_nowhere(file, "timeouts")
    assert "`timeouts`: is a link to `/nowhere`" in refusal(path, tmp_path / "out")


@pytest.mark.parametrize("libver", ["earliest", "latest"])
def test_links_within_the_file_are_followed(libver, plain, tmp_path):
    columns = {f"deep/{name}": values for name, values in arrays().items()}
    path = write(tmp_path / "x.h5", columns, libver)
    with h5py.File(path, "a", libver=libver) as file:
        for name in ["observations", "actions", "rewards", "infos"]:
            file[name] = h5py.SoftLink(f"/deep/{name}")
        for name in ["terminals", "timeouts"]:
            file[name] = file[f"deep/{name}"]
    assert log(path, tmp_path / "out") == plain


def test_gymnasiums_names_mean_the_same(plain, tmp_path):
    columns = arrays()
    columns["truncations"], columns["terminations"] = columns.pop("timeouts"), columns.pop("terminals")
    assert log(write(tmp_path / "gym.h5", columns), tmp_path / "gym") == plain
    both = arrays()
    early, late = both["timeouts"].copy(), both["timeouts"].copy()
    early[ROWS // 4 :], late[: ROWS // 4] = False, False
    both["timeouts"], both["truncations"] = early, late
    assert log(write(tmp_path / "both.h5", both), tmp_path / "both") == plain, "any flag in any of them ends an episode"


def test_without_timeouts_the_log_says_how_episodes_end(tmp_path):
    columns = arrays()
    del columns["timeouts"]
    done = train(write(tmp_path / "x.h5", columns), tmp_path / "out")
    assert "no `timeouts` or `truncations`, so episodes end at `terminals` only; the longest of 6 has 168 steps" in done.stderr


def test_short_episodes_are_left_out_and_said(tmp_path):
    """One early fall refused a file of hundreds of episodes."""
    columns = arrays()
    columns["terminals"][2] = True
    done = train(write(tmp_path / "x.h5", columns), tmp_path / "out")
    assert done.returncode == 0 and "left out 1 of 13 episodes shorter than 6 steps (`losses.elbo.length` + 1)" in done.stderr, done.stderr
    probe = [str(TRAINER), "probe", str(tmp_path / "out"), str(tmp_path / "x.h5"), "--json"]
    told = subprocess.run(probe, capture_output=True, text=True, cwd=ROOT, timeout=300, check=True)
    assert "left out 1 of 13 episodes" in told.stderr and json.loads(told.stdout)


def of_episodes(values: Any) -> np.ndarray:
    """One value for each episode, in all of its steps."""
    return np.repeat(np.asarray(values), STEPS)


def test_play_is_learned_from_and_not_imitated(tmp_path):
    """What each loss draws from shows in its first value: all episodes, those of play, those to imitate."""
    play = {"infos/play": of_episodes(np.arange(EPISODES) % 2 == 0)}
    few = [
        "--set",
        "stages.identify.steps=2",
        "--set",
        "stages.denoise.steps=2",
        "--set",
        "log_every=1",
        "--set",
        "stages.denoise.trains.latent=0",
    ]

    def first(name: str, columns: Arrays, *flags: str) -> tuple[float, float]:
        done = train(write(tmp_path / f"{name}.h5", columns), tmp_path / name, *few, *flags)
        assert done.returncode == 0 and ("6 of them are play, which is not imitated" in done.stderr) == ("infos/play" in columns), (
            done.stderr
        )
        lines = [json.loads(line) for line in (tmp_path / name / "training/log.jsonl").read_text().splitlines()]
        return tuple(next(line[key] for line in lines if key in line) for key in ("elbo", "loss"))

    plain, marked = first("plain", arrays()), first("marked", arrays() | play)
    drawn = first("drawn", arrays() | play, "--set", "losses.elbo.episodes=play")
    assert plain[0] == marked[0] != drawn[0], "the ELBO"
    assert plain[1] != marked[1], "the planner"


def test_what_is_play_is_said_for_whole_episodes_and_leaves_something_to_imitate(tmp_path):
    mixed = of_episodes(np.zeros(EPISODES, np.bool_))
    mixed[3 * STEPS + 2] = True
    words = f"`infos/play`: changes at row {3 * STEPS + 2}, within the episode that begins at row {3 * STEPS}"
    assert words in refusal(write(tmp_path / "mixed.h5", arrays() | {"infos/play": mixed}), tmp_path / "mixed")
    for value, flags, key in ((True, [], "losses.denoise"), (False, ["--set", "losses.elbo.episodes=play"], "losses.elbo.episodes")):
        columns = arrays() | {"infos/play": of_episodes(np.full(EPISODES, value))}
        done = train(write(tmp_path / "x.h5", columns), tmp_path / f"{value}", *flags)
        assert done.returncode == 1 and f"recipe: `{key}`: of the episodes" in done.stderr and "infos/play" in done.stderr, done.stderr


def test_episodes_of_a_session_follow_one_another(plain, tmp_path):
    """Histories then cross the border, which changes what is learned; numbered one by one, nothing does."""
    alone = arrays() | {"infos/session": of_episodes(np.arange(EPISODES))}
    assert log(write(tmp_path / "alone.h5", alone), tmp_path / "alone") == plain
    paired = arrays() | {"infos/session": of_episodes(np.arange(EPISODES) // 2)}
    assert log(write(tmp_path / "paired.h5", paired), tmp_path / "paired") != plain
    one = arrays() | {"infos/session": of_episodes(np.zeros(EPISODES, np.int64))}
    assert "`infos/session`: all episodes are of one session" in refusal(write(tmp_path / "one.h5", one), tmp_path / "one")
    stamps = arrays() | {"infos/session": of_episodes(1_700_000_000 + np.arange(EPISODES))}
    assert "`infos/session`: has the number 17000000" in refusal(write(tmp_path / "stamps.h5", stamps), tmp_path / "stamps")
    sessions = [json.loads((tmp_path / name / "config.json").read_text())["trained"].get("sessions", False) for name in ("alone", "paired")]
    assert sessions == [False, True]


def strange(dtype: Any) -> Callable[[h5py.File, np.ndarray], None]:
    return lambda file, values: file.create_dataset("actions", values.shape, dtype) and None


def low_level(change: Callable[[Any], None], base: Any) -> Callable[[h5py.File, np.ndarray], None]:
    def make(file: h5py.File, values: np.ndarray) -> None:
        kind = base.copy()
        change(kind)
        h5py.h5d.create(file.id, b"actions", kind, h5py.h5s.create_simple(values.shape))

    return make


def bfloat16(kind: Any) -> None:
    kind.set_fields(15, 7, 8, 0, 7)
    kind.set_ebias(127)


def twelve_bits(kind: Any) -> None:
    kind.set_precision(12)


def filtered(file: h5py.File, values: np.ndarray) -> None:
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk(values.shape)
    plist.set_filter(32015, h5py.h5z.FLAG_OPTIONAL, (3,))
    space = h5py.h5s.create_simple(values.shape)
    array = h5py.h5d.create(file.id, b"actions", h5py.h5t.IEEE_F32LE, space, plist)
    array.write_direct_chunk((0, 0), b"\x28\xb5\x2f\xfd")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (strange("S4"), "holds strings"),
        (strange("c8"), "holds complex numbers"),
        (strange([("x", "f4"), ("y", "f4")]), "holds records of x, y"),
        (strange(np.longdouble), "128-bit floats"),
        (strange("V4"), "opaque bytes"),
        (strange(h5py.vlen_dtype("f4")), "holds lists"),
        (strange(h5py.ref_dtype), "holds references"),
        (low_level(bfloat16, h5py.h5t.IEEE_F16LE), "16-bit floats in an unusual format"),
        (low_level(twelve_bits, h5py.h5t.STD_I16LE), "16-bit integers in an unusual format"),
        (filtered, "not understood (filter id 32015"),
    ],
)
def test_what_is_not_understood_is_refused_by_name(make, words, tmp_path):
    columns = arrays()
    values = columns.pop("actions")
    path = write(tmp_path / "x.h5", columns)
    with h5py.File(path, "a") as file:
        make(file, values)
    error = refusal(path, tmp_path / "out")
    assert "`actions`" in error and words in error, error


def minari(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for episode in range(3):
            for name, values in arrays().items():
                file.create_dataset(f"episode_{episode}/{name}", data=values[:STEPS])


def robomimic(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("data/demo_0/actions", data=np.zeros((9, 2)))
        file.create_dataset("mask/train", data=[b"demo_0"])


def lerobot(path: Path) -> None:
    (path / "meta").mkdir(parents=True)
    (path / "meta/info.json").write_text("{}")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (minari, "this is a file of Minari"),
        (robomimic, "this is a file of robomimic or LIBERO"),
        (lerobot, "is a folder (a LeRobot data set)"),
        (lambda path: path.mkdir(), "is a folder"),
        (lambda path: path.write_bytes(b"PAR1" + bytes(100)), "is a Parquet file"),
        (lambda path: np.savez(path.open("wb"), observations=np.zeros(3)), "is a ZIP archive"),
    ],
    ids=["minari", "robomimic", "lerobot", "folder", "parquet", "npz"],
)
def test_other_layouts_are_told_what_they_are(make, words, tmp_path):
    path = tmp_path / "x.h5"
    make(path)
    error = refusal(path, tmp_path / "out")
    assert words in error and "docs/data.md" in error, error


def most_memory(data: Path, out: Path, *flags: str) -> float:
    """MiB that a run held at its peak, as far as looking every few milliseconds tells."""
    command = [TRAINER, "run", RECIPE, "--data", data, "--out", out, *flags]
    run = subprocess.Popen([str(word) for word in command], stderr=subprocess.DEVNULL, cwd=ROOT)
    most = 0
    while run.poll() is None:
        lines = Path(f"/proc/{run.pid}/status").read_text().splitlines()
        most = max([most, *(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))])
        time.sleep(0.005)
    assert run.returncode == 0 and most > 0
    return most / 1024


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell how much memory a process held")
def test_a_huge_array_that_nobody_asked_for_costs_nothing(tmp_path):
    """The whole file was read into memory: 2 GiB of camera images that the trainer never looks at cost 2 GiB."""
    path = write(tmp_path / "x.h5", arrays())
    with h5py.File(path, "a") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        plist.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        space = h5py.h5s.create_simple((2 << 30,))
        h5py.h5d.create(file.id, b"images", h5py.h5t.STD_U8LE, space, plist)
        file.create_dataset("more", (24 << 30,), "u1", chunks=(1 << 20,))
    assert path.stat().st_size > 2 << 30 and path.stat().st_blocks * 512 < 100 << 20, "the file is sparse"
    assert most_memory(path, tmp_path / "out") < 300


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system does not tell how much memory a process held")
def test_a_data_set_larger_than_its_memory_trains(tmp_path):
    """All rows were in memory, more than once: these 150 MB took 494."""
    rng, rows = np.random.default_rng(2), 600_000
    columns = {
        "observations": rng.normal(size=(rows, 60)).astype(np.float32),
        "actions": rng.uniform(-1, 1, (rows, 2)).astype(np.float32),
        "rewards": rng.normal(size=rows).astype(np.float32),
        "terminals": np.arange(rows) % 500 == 499,
    }
    assert most_memory(write(tmp_path / "x.h5", columns), tmp_path / "out", "--data-memory-mib", "16") < 100


def test_rows_in_a_file_give_the_same_log(plain, tmp_path):
    data, out = write(tmp_path / "x.h5", arrays(), **GZIP), tmp_path / "out"
    few = ["--set", "stages.identify.steps=2", "--set", "stages.denoise.steps=2", "--set", "log_every=1"]
    done = train(data, out, "--data-memory-mib", "0", *few)
    assert done.returncode == 0 and "more than --data-memory-mib allows (0): kept in a file" in done.stderr, done.stderr
    assert (out / "training/log.jsonl").read_text() == plain


def example(title: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Runs the example of docs/data.md that stands under a title, in a folder."""
    text = (ROOT / "docs/data.md").read_text(encoding="utf-8")
    code = text.split(f"\n{title} ", 1)[1].split("```python\n", 1)[1].split("```", 1)[0]
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=120, check=True)


def test_the_way_out_of_lerobot(tmp_path):
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    columns = arrays()
    (tmp_path / "lerobot/data/chunk-000").mkdir(parents=True)
    for index, steps in enumerate(episodes_of(columns)):
        table = {"observation.state": list(steps["observations"]), "action": list(steps["actions"]), "episode_index": [index] * STEPS}
        parquet.write_table(arrow.table(table), tmp_path / f"lerobot/data/chunk-000/episode_{index:06d}.parquet")
    example("LeRobot", tmp_path)
    ends = columns["terminals"] | columns["timeouts"]
    same = {"observations": columns["observations"], "actions": columns["actions"], "rewards": np.zeros(ROWS, "f4"), "terminals": ends}
    assert log(tmp_path / "data.h5", tmp_path / "a") == log(write(tmp_path / "same.h5", same), tmp_path / "b")


@pytest.mark.parametrize(("scale", "shift"), [(1 / 128, 0), (1, 100), (4096, -(2**20))])
def test_actions_in_another_unit_train_the_same_bits(plain: str, tmp_path: Path, scale: float, shift: float) -> None:
    """Bounds began at -1 and 1 and only grew: actions a hundred times smaller were learnt with an error of .59 not .006, in silence."""
    columns = arrays()
    columns["actions"] = (columns["actions"] * scale + shift).astype(np.float32)
    assert log(write(tmp_path / "other.h5", columns), tmp_path / "out") == plain
    done = train(tmp_path / "other.h5", tmp_path / "out2", "--set", "stages.identify.steps=1", "--set", "stages.denoise.steps=1")
    low, high = float(shift), float(shift + scale)
    assert f"actions: bounds [{low}, {low}] .. [{high}, {high}], to -1 .. 1" in done.stderr
    warned = "warning: actions, column 1: is scaled by" in done.stderr
    assert warned == (not 0.1 <= scale / 2 <= 10)


def test_one_broken_reading_is_counted_and_held(tmp_path: Path) -> None:
    columns = arrays()
    columns["actions"] = np.linspace(-1, 1, 2 * ROWS).reshape(ROWS, 2).astype(np.float32)
    columns["actions"][5, 0] = 1e6
    done = train(
        write(tmp_path / "broken.h5", columns), tmp_path / "out", "--set", "stages.identify.steps=1", "--set", "stages.denoise.steps=1"
    )
    assert done.returncode == 0, done.stderr
    assert "column 0: reaches from" in done.stderr and "1 value(s) are held within the bounds" in done.stderr
