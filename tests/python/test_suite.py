"""`ada-suite`: a tiny suite on the real programs, stopped and gone on with; what is refused, and what is done again."""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from server import BINARY, ROOT, descendants, gone

from ada_diffuser.commands.suite import main
from ada_diffuser.rollout import Episode
from ada_diffuser.suite.cell import Places, cells
from ada_diffuser.suite.measure import plan
from ada_diffuser.suite.schedule import Durations, next_cell
from ada_diffuser.suite.suite import Suite

TINY = (ROOT / "report/suites/tiny.toml").read_text(encoding="utf-8")
GOLDEN = ROOT / "tests/golden/suite"
#: What another run of the same cell may have otherwise.
TIMES = ("train_seconds", "rollout_seconds", "p50_ms")


class Place:
    """A working directory with a suite in it."""

    def __init__(self, folder: Path, text: str = TINY) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)
        if not (folder / "models").exists():
            (folder / "models").symlink_to(ROOT / "models")
        self.write(text)

    def write(self, text: str) -> None:
        (self.folder / "tiny.toml").write_text(text, encoding="utf-8")

    def command(self, *words: str) -> list[str]:
        return [sys.executable, "-m", "ada_diffuser.commands.suite", *words]

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """`ada-suite run tiny.toml`, to its end."""
        command = self.command("run", "tiny.toml", "--programs", str(BINARY.parent), *words)
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False, timeout=300)

    def files(self) -> dict[str, dict[str, Any]]:
        """What was found, by method and mode."""
        paths = sorted((self.folder / "report/cells/tiny/point-wind-s").glob("*/*.json"))
        return {f"{path.parent.name}/{path.stem}": json.loads(path.read_text(encoding="utf-8")) for path in paths}

    def found(self) -> dict[str, dict[str, Any]]:
        """The same but for times."""
        return {name: {key: value for key, value in file.items() if key not in TIMES} for name, file in self.files().items()}

    def log(self, method: str) -> str:
        return (self.folder / f"runs/suite/tiny/point-wind-s/{method}/seed0.log").read_text(encoding="utf-8")

    def copy(self, folder: Path, text: str = TINY) -> Place:
        shutil.copytree(self.folder, folder, symlinks=True)
        return Place(folder, text)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Place:
    place = Place(tmp_path_factory.mktemp("suite"))
    told = place.run("--json")
    assert told.returncode == 0, told.stderr
    assert json.loads(told.stdout)["failed"] == [] and len(json.loads(told.stdout)["finished"]) == 2
    assert "(2 of 2 cells)" in told.stderr
    return place


def test_each_cell_leaves_what_was_asked_for(done: Place) -> None:
    files = done.files()
    assert list(files) == ["diffuser/seed0-cold", "ours/seed0-cold", "ours/seed0-streaming"]
    for name, file in files.items():
        returns = np.array(file["returns"])
        assert (file["suite"], file["environment"], file["seed"], file["episodes"]) == ("tiny", "point-wind-s", 0, 4)
        assert file["method"] in name and file["mode"] in name and file["options"]["streaming"] == (file["mode"] == "streaming")
        assert file["mean"] == pytest.approx(returns.mean(), abs=1e-3) and file["median"] == pytest.approx(np.median(returns), abs=1e-3)
        assert file["se"] == pytest.approx(returns.std(ddof=1) / 2, abs=1e-3) and 0 <= file["failures"] <= 4
        assert file["p50_ms"] > 0 and file["train_seconds"] > 0 and set(file["machine"]) == {"cpu", "vectors", "cores", "cells_at_once"}
        assert len(file["checkpoint"]) == 64 and file["data"]["episodes"] == 24
        assert file["plan"]["ahead"] == [1, 2, 3, 4, 5, 6, 7]
    cold, streaming, diffuser = files["ours/seed0-cold"], files["ours/seed0-streaming"], files["diffuser/seed0-cold"]
    assert cold["evaluations_per_act"] == 8 > streaming["evaluations_per_act"] and diffuser["evaluations_per_act"] == 4
    assert cold["probe"][-2]["block_len"] == 10 and cold["readout"]["ages"][0]["age"] == [0, 40] and len(cold["latents"]["points"]) == 160
    assert (diffuser["probe"], diffuser["readout"], diffuser["latents"]) == (None, None, None)
    assert cold["steps"] == {"identify": 40, "denoise": 60} and diffuser["steps"] == {"denoise": 60}
    assert (done.log("ours") + done.log("diffuser")).count("collects ") == 1, "a data set is made once"
    assert not list((done.folder / "runs/suite/tiny/served").rglob("*.safetensors"))


def test_nothing_is_probed_where_nothing_is_inferred(done: Place, tmp_path: Path) -> None:
    """An oracle trained for minutes, and its cell failed: it has a latent, which is the truth."""
    oracle = """
[methods.oracle]
with = ["models/methods/oracle.toml"]
set = ["losses.denoise.batch=16", "stages.denoise.steps=20"]
modes = ["cold"]
"""
    place = done.copy(tmp_path / "place", TINY + oracle)
    told = place.run("--only", "*/oracle/*")
    assert told.returncode == 0 and "(1 of 1 cells)" in told.stderr, told.stderr
    assert place.files()["oracle/seed0-cold"]["probe"] is None


def test_what_is_done_is_not_done_again(done: Place) -> None:
    paths = sorted(done.folder.glob("report/cells/**/*.json"))
    before = [path.stat().st_mtime_ns for path in paths], done.log("ours")
    told = done.run()
    assert told.returncode == 0 and "2 of 2 cells are done" in told.stderr and "seed0" not in told.stderr
    assert before == ([path.stat().st_mtime_ns for path in paths], done.log("ours"))


def test_status_tells_what_is_missing(done: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    place = done.copy(tmp_path / "place", TINY.replace("seeds = [0]", "seeds = [0, 1]"))
    monkeypatch.chdir(place.folder)
    assert main(["status", "tiny.toml"]) == 0
    told = capsys.readouterr().out
    assert "done   point-wind-s/ours/seed0\n" in told and "to do  point-wind-s/ours/seed1: cold, streaming\n" in told
    assert "2 of 4 cells are done, about 0:0" in told
    assert main(["status", "tiny.toml", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [one["missing"] for one in told["cells"]] == [[], [], ["cold", "streaming"], ["cold"]] and told["seconds_left"] > 0
    assert main(["status", "tiny.toml", "--only", "*/diffuser/seed1", "*/seed1"]) == 0
    told = capsys.readouterr().out
    assert told.index("diffuser/seed1") < told.index("ours/seed1") and "seed0" not in told, "in the order of the patterns, each once"
    assert main(["status", "tiny.toml", "--only", "*/seed1", "gale/*"]) == 1
    assert "--only gale/*: there is no such cell" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_stopped_in_the_middle_it_goes_on_and_finds_the_same(done: Place, tmp_path: Path, number: signal.Signals) -> None:
    """While `ours` is being trained: everything it started ends with it, and the same command finishes what it had begun."""
    place = Place(tmp_path / "place")
    command = place.command("run", "tiny.toml", "--programs", str(BINARY.parent), "--jobs", "1")
    # A shell has what it runs in the background ignore Ctrl-C, and these tests with it.
    heard = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(command, cwd=place.folder, stderr=subprocess.DEVNULL, preexec_fn=heard) as running:
        _until(lambda: list(place.folder.glob(f"runs/suite/trainings/point-wind-s-recipe-{'?' * 16}-seed0/training/state.safetensors")))
        started = descendants(running.pid)
        assert len(started) >= 2, "a worker and a trainer"
        assert all(len(os.sched_getaffinity(pid)) == 1 for pid in started), "a training takes all the cores that it sees"
        running.send_signal(number)
        assert running.wait(60) == (130 if number == signal.SIGINT else -signal.SIGKILL)
    for pid in started:
        gone(pid)
    assert not place.files()
    if number == signal.SIGINT:
        assert "the same command goes on" in place.log("ours"), "the trainer was asked to stop, and had the time to"
    assert place.run().returncode == 0
    assert "going on at" in place.log("ours"), "it was in the middle of a training"
    assert place.found() == {name: _at_once(file, 2) for name, file in done.found().items()}
    assert [path.name for path in place.folder.glob("report/**/*.partial")] == []


def test_a_killed_program_fails_its_cell_alone(tmp_path: Path) -> None:
    """A trainer that somebody kills takes its cell along, and nothing else; the next run mends it."""
    place = Place(tmp_path / "place")
    with subprocess.Popen(
        place.command("run", "tiny.toml", "--programs", str(BINARY.parent)), cwd=place.folder, stderr=subprocess.PIPE, text=True
    ) as running:
        _until(lambda: list(place.folder.glob(f"runs/suite/trainings/point-wind-s-recipe-{'?' * 16}-seed0/training/state.safetensors")))
        commands = {pid: Path(f"/proc/{pid}/cmdline").read_text() for pid in descendants(running.pid)}
        trainers = [pid for pid, command in commands.items() if "recipe.toml" in command and "--with" not in command]
        assert trainers
        os.kill(trainers[-1], signal.SIGKILL)
        _, told = running.communicate(timeout=120)
    assert running.returncode == 1
    assert (
        "failed: point-wind-s/ours/seed0: " in told
        and "ada-trainer run ended with -9; see runs/suite/tiny/point-wind-s/ours/seed0.log" in told
    )
    assert told.endswith("1 of 2 cells failed; the same command tries them again\n")
    assert list(place.files()) == ["diffuser/seed0-cold"]
    assert place.run().returncode == 0 and len(place.files()) == 3


def test_a_changed_key_does_that_cell_again_and_no_other(done: Place, tmp_path: Path) -> None:
    place = done.copy(tmp_path / "place")
    before = place.found()
    place.write(TINY.replace('"model.plan.schedule.steps=4",', '"model.plan.schedule.steps=4", "sampler.temperature=0.5",'))
    told = place.run()
    assert told.returncode == 0 and "1 of 2 cells are done" in told.stderr, told.stderr
    after = place.found()
    assert [name for name in after if after[name] != before[name]] == ["diffuser/seed0-cold"]
    assert after["diffuser/seed0-cold"]["options"]["temperature"] == 0.5
    assert "is trained: " in place.log("diffuser"), "how it is sampled is nothing to train for"


def test_a_failing_cell_is_told_at_the_end_and_the_others_go_on(done: Place, tmp_path: Path) -> None:
    lilac = '\n[methods.lilac]\nwith = ["models/methods/lilac.toml"]\nmodes = ["cold"]\n'
    place = done.copy(tmp_path / "place", TINY.replace("\n[methods.diffuser]", f"{lilac}\n[methods.diffuser]"))
    (place.folder / "report/cells/tiny/point-wind-s/diffuser/seed0-cold.json").unlink()
    told = place.run("--jobs", "1", "--json")
    assert told.returncode == 1 and len(place.files()) == 3
    (failed,) = json.loads(told.stdout)["failed"]
    assert failed["cell"] == "point-wind-s/lilac/seed0" and "losses.elbo.length" in failed["reason"]
    assert (place.folder / failed["log"]).exists()


def refused(folder: Path, text: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What the command says of a suite that it must not take."""
    place = Place(folder, text)
    assert main(["run", str(place.folder / "tiny.toml"), "--programs", str(BINARY.parent)]) == 1
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1 and told.err.startswith("ada-suite: "), told
    return told.err


@pytest.mark.parametrize(
    ("before", "after", "names"),
    [
        ("seeds = [0]", "seed = [0]", "tiny.toml: seed is no key here; there are title, seeds"),
        ("seeds = [0]", "seeds = [0, 0]", "seeds must be training seeds, each once"),
        ("seeds = [0]", 'seeds = ["0"]', "seeds must be a list, each a whole number, not ['0']"),
        ('reference = "ours"', 'reference = "theirs"', "reference 'theirs' is no method; there are ours, diffuser"),
        ("episodes = 4", "episodes = 1", "evaluation.episodes must be at least 2, not 1"),
        ("episodes = 4", "episode = 4", "evaluation.episode is no key here"),
        ("episodes = 4", 'modes = ["warm"]', "evaluation.modes must be some of cold, streaming"),
        ("[environments.point-wind-s]", "[environments.'a b']", "'a b' cannot be the name of a file"),
        ("episode_steps = 40", "steps = 40", "environments.point-wind-s.steps is no key here; there are env, options, episode_steps"),
        ("collect = { episodes = 24 }", "", "environments.point-wind-s.collect or data must be given"),
        ("collect = { episodes = 24 }", "collect = { episodos = 24 }", "environments.point-wind-s.collect: ada-collect: unrecognized"),
        ("collect = { episodes = 24 }", "collect = { out = 'x' }", "environments.point-wind-s.collect.out is said by the suite itself"),
        ("collect = { episodes = 24 }", "data = 'x.h5'", "environments.point-wind-s.data: there is no x.h5; say how it is made"),
        ("[methods.ours]\nrecipe", "[methods.ours]\nreceipt", "methods.ours.receipt is no key here; there are recipe, with"),
        ("models/{environment}/recipe.toml", "models/nowhere.toml", "methods.ours.recipe: models/nowhere.toml"),
        ("models/methods/diffuser.toml", "models/methods/none.toml", "methods.diffuser.with: models/methods/none.toml"),
        ('\nrecipe = "models/point-wind-s/recipe.toml"', "", "methods.diffuser.recipe must be given: no environment has one of its own"),
        ('"models/{environment}/recipe.toml"', "{ mars = 'x' }", "methods.ours.recipe.mars is of no environment"),
        ('"checkpoint_every=20"', '"checkpoint_every"', "methods.ours.set has 'checkpoint_every', which is not KEY=VALUE"),
        ("[methods.diffuser]", "vary = { x = 1 }\n[methods.diffuser]", "methods.ours.vary.x must be a list of values"),
        ("[methods.diffuser]", "[paper.mars]\n[methods.diffuser]", "paper.mars is of no environment"),
        ("[methods.diffuser]", "[paper.point-wind-s]\nhers = 1\n[methods.diffuser]", "paper.point-wind-s.hers is of no method"),
        ("seeds = [0]", "seeds = [0", "tiny.toml: "),
        ("episode_steps = 40", "env = 'point-wind-x'", "unknown environment 'point-wind-x'"),
    ],
)
def test_a_wrong_suite_is_refused_by_name(
    before: str, after: str, names: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert before in TINY
    assert names in refused(tmp_path, TINY.replace(before, after), capsys)
    assert not (tmp_path / "report").exists() and not (tmp_path / "runs").exists()


def test_programs_and_cells_that_are_not_there_are_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    suite = str(ROOT / "report/suites/tiny.toml")
    for words, names in [
        (["run", suite, "--programs", str(tmp_path)], "there is no ada-trainer"),
        (["run", str(tmp_path / "x.toml")], "there is no suite"),
        (["run", suite, "--jobs", "0"], "--jobs must be at least 1"),
        (["cell", suite, "mars/ours/seed0", "--programs", str(BINARY.parent)], "has no cell mars/ours/seed0"),
        (["report", suite, "--cells", str(tmp_path), "--out", str(tmp_path)], "there is no finished cell"),
    ]:
        assert main(words) == 1
        told = capsys.readouterr()
        assert names in told.err and told.err.count("\n") == 1, told


def test_keys_change_with_what_changes_numbers_and_with_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = (ROOT / "models/point-wind-s/recipe.toml").read_text(encoding="utf-8")
    (tmp_path / "models/point-wind-s").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)

    def keys(text: str = TINY, recipe: str = recipe) -> tuple[str, str]:
        """Of the training and of what is found."""
        Path("models/point-wind-s/recipe.toml").write_text(recipe, encoding="utf-8")
        Path("tiny.toml").write_text(text, encoding="utf-8")
        cell = next(one for one in cells(Suite.load(Path("tiny.toml"))) if one.method.family == "ours")
        return cell.training(Places()).name, cell.key("streaming")

    training, key = keys()
    alike = (TINY.replace('title = "A', 'title = "Another'), TINY + "\n[paper.point-wind-s]\nours = 1\n", TINY.replace("[0]", "[0, 1]"))
    assert all(keys(text) == (training, key) for text in alike)
    assert keys(recipe=recipe + "\n# a word\n") == (training, key), "words are no numbers"
    for text in (TINY.replace("episodes = 4", "episodes = 5"), TINY.replace("checkpoint_every=20", "sampler.kappa=inf")):
        assert keys(text)[1] != key
    assert keys(TINY.replace("episodes = 4", "episodes = 5"))[0] == training
    others = (
        TINY.replace("identify.steps=40", "identify.steps=41"),
        TINY.replace("episodes = 24", "episodes = 25"),
        TINY.replace("[0]", "[1]"),
    )
    for other in [*(keys(text) for text in others), keys(recipe=recipe.replace("width = 48", "width = 32"))]:
        assert other[0] != training and other[1] != key


def test_what_samplers_ask_is_nothing_to_train_for(tmp_path: Path) -> None:
    text = TINY.replace("[methods.diffuser]", "vary = { 'sampler.kappa' = [0.0, inf], 'model.latent.dim' = [3] }\n[methods.diffuser]")
    (tmp_path / "a.toml").write_text(text.replace('reference = "ours"', ""), encoding="utf-8")
    suite = Suite.load(tmp_path / "a.toml")
    assert list(suite.methods) == ["ours,sampler.kappa=0.0", "ours,sampler.kappa=inf", "ours,model.latent.dim=3", "diffuser"]
    off, on, narrow, _ = cells(suite)
    assert off.training_keys == on.training_keys and on.default_keys == ["sampler.kappa=inf"]
    assert on.method.varied == ("sampler.kappa", float("inf"))
    assert "model.latent.dim=3" in narrow.training_keys and not narrow.default_keys
    finer = replace(on, method=replace(on.method, keys=("sampler.sub_steps=2", "restart.latent_jump=1")))
    assert finer.training_keys == ["sampler.sub_steps=2"], "sub-steps are trained"


def test_what_an_environment_sets_all_methods_have_and_may_overrule(tmp_path: Path) -> None:
    text = TINY.replace("[environments.point-wind-s]", "[environments.point-wind-s]\nset = ['stages.denoise.steps=7', 'sampler.kappa=0.0']")
    (tmp_path / "a.toml").write_text(text, encoding="utf-8")
    (tmp_path / "b.toml").write_text(TINY, encoding="utf-8")
    ours, diffuser = cells(Suite.load(tmp_path / "a.toml"))
    for one in (ours, diffuser):
        assert one.training_keys[0] == "stages.denoise.steps=7" and one.default_keys[0] == "sampler.kappa=0.0"
        assert one.training_keys[1:] == [key for key in one.method.keys if not key.startswith("sampler.kappa")]
    plain = cells(Suite.load(tmp_path / "b.toml"))[0]
    assert plain.training(Places()) != ours.training(Places()) and plain.key("streaming") != ours.key("streaming")


def test_durations_tell_how_long_the_rest_takes() -> None:
    suite = Suite.load(GOLDEN / "golden.toml")
    of = {cell.name: cell for cell in cells(suite)}
    ours, looks, diffuser = (of[f"point-wind-s/{name}/seed0"] for name in ("ours", "looks,model.latent.looks.block=2", "diffuser"))
    durations = Durations({})
    assert durations.left([ours], [], 2) is None, "nothing is known yet"
    durations.note(ours, [{"train_seconds": 90.0, "rollout_seconds": 6.0}, {"train_seconds": 90.0, "rollout_seconds": 4.0}])
    durations.note(diffuser, [{"train_seconds": 30.0, "rollout_seconds": 10.0}])
    assert (durations.of_cell(ours), durations.of_cell(diffuser), durations.of_cell(looks)) == (100, 40, 70)
    assert durations.left([ours, diffuser], [], 2) == 70 and durations.left([ours, diffuser], [], 1) == 140
    assert durations.left([], [(ours, 30.0)], 2) == 70, "one at work is not shared by two"
    assert durations.left([], [(ours, 200.0)], 2) == 20, "what is late is not finished"


def test_a_training_that_is_under_way_is_not_waited_for() -> None:
    """Two methods that differ in their sampler alone share it: meanwhile another cell comes first."""
    suite = Suite.load(GOLDEN / "golden.toml")
    ours, *_, diffuser = cells(suite)[: len(suite.methods)]
    twin = replace(ours, method=replace(ours.method, name="twin", keys=(*ours.method.keys, "sampler.kappa=inf")))
    assert twin.training(Places()) == ours.training(Places()) and twin.key("cold") != ours.key("cold")
    assert next_cell([twin, diffuser], [ours], Places()) == diffuser
    assert next_cell([twin], [ours], Places()) is None and next_cell([twin, diffuser], [], Places()) == twin


def test_a_plan_is_held_against_the_states_of_its_own_steps() -> None:
    """The first state of a plan is the one after the chunk: with chunks of two, two steps after the act."""
    states = [np.array([np.sin(step), 5.0], np.float32) for step in range(12)]
    for horizon in (1, 2):
        steps = list(range(0, 12, horizon))
        plans = [np.array([[np.sin(step + horizon + k), 5.0] for k in range(3)], np.float32) for step in steps]
        told = plan([Episode(0, states=states, act_steps=steps, plans=plans)], horizon, drawn=True)
        assert told is not None and told["ahead"] == [horizon, horizon + 1, horizon + 2]
        assert told["error"] == pytest.approx([0, 0, 0], abs=1e-5) and told["column"] == 0
        assert told["plans"][0]["step"] == horizon and told["plans"][0]["states"] == pytest.approx(told["states"][horizon : horizon + 3])
        late = plan([Episode(0, states=states, act_steps=steps, plans=[one + np.array([1.0, 0.0]) for one in plans])], horizon, drawn=False)
        assert late is not None and late["error"][0] == pytest.approx(1 / np.var([state[0] for state in states]), rel=1e-3)
    assert plan([Episode(0, states=states)], 1, drawn=True) is None


def test_the_readme_has_an_example_of_every_key(tmp_path: Path) -> None:
    text = (ROOT / "clients/python/README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"^```toml\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    (tmp_path / "example.toml").write_text(example, encoding="utf-8")
    suite = Suite.load(tmp_path / "example.toml")
    assert len(suite.methods) == 3 + 5 and len(cells(suite)) == 3 * (2 + 1 + 1 + 5)
    for key in (
        "title",
        "seeds",
        "reference",
        "episodes",
        "modes",
        "env",
        "options",
        "episode_steps",
        "collect",
        "data",
        "recipe",
        "set",
        "vary",
    ):
        assert re.search(rf"^{key} = ", example, re.MULTILINE), key
    assert suite.paper["cheetah-wind-s"] == {"ours": -73.5, "without": "-102.0 (DF-style)"}
    assert all(cell.recipe.is_relative_to("models") and (ROOT / cell.recipe).exists() for cell in cells(suite))


def test_every_suite_in_the_report_can_be_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for path in sorted(Path("report/suites").glob("*.toml")):
        found = cells(Suite.load(path))
        assert found and all(cell.key(mode) for cell in found for mode in cell.method.modes), path


def _at_once(file: dict[str, Any], count: int) -> dict[str, Any]:
    return {**file, "machine": {**file["machine"], "cells_at_once": count}}


def _until(true: Callable[[], object], within_s: float = 120.0) -> None:
    end = time.monotonic() + within_s
    while not true():
        assert time.monotonic() < end, "it does not come"
        time.sleep(0.01)
