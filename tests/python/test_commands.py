"""The command lines as a day's use meets them: somebody else's environment, folders that are not there, logs, one message a mistake."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from server import running

from ada_diffuser.commands import evaluate, progress, rollout, run_command
from ada_diffuser.commands.collect import main as collect
from ada_diffuser.commands.outputs import check_output, save_json
from ada_diffuser.rollout import film, plot

THEIRS = """
import gymnasium, numpy
from gymnasium import spaces

class Theirs(gymnasium.Env):
    observation_space, action_space = spaces.Box(-9.0, 9.0, (4,)), spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-.1, .1, size=4), {}

    def step(self, action):
        return self.np_random.uniform(-.1, .1, size=4), -float(action @ action), False, False, {}

gymnasium.register("Theirs-v0", Theirs, max_episode_steps=5)
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running(tmp_path_factory.mktemp("server") / "log") as address:
        yield address


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    (tmp_path / "their_module.py").write_text(THEIRS)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("their_module", None)
    gymnasium.registry.pop("Theirs-v0", None)


def quick(address: str, *words: str) -> list[str]:
    return ["--env", "their_module:Theirs-v0", "--url", address, "--episodes", "2", *words]


def test_somebody_elses_environment_is_driven_and_judged(here: Path, address: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Only the environments of this package could be named, and every episode was taken to have 200 steps."""
    assert rollout.main(quick(address, "--model", "tiny", "--json", "new/folder/a.json")) == 0
    told = json.loads(Path("new/folder/a.json").read_text())
    assert told["env"] == "their_module:Theirs-v0" and told["acts"] == 10 and len(told["returns"]) == 2
    assert evaluate.main(quick(address, "--models", "tiny", "--episode-steps", "3", "--set", "streaming=true,false")) == 0
    assert "| their_module:Theirs-v0 | tiny | false |" in capsys.readouterr().out


def test_a_rollout_has_the_environments_options(
    here: Path, address: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`ada-evaluate` alone took them, so that no film could be made of the speeds that it was asked about."""
    words = ["--env", "point-wind-s", "--url", address, "--model", "tiny", "--episodes", "1", "--episode-steps", "6"]
    told, filmed = [], []
    monkeypatch.setattr(film, "save_film", lambda panels, path: filmed.append(panels[0].env_options))
    for options in ([], ["--env-option", "sigma=0.5"]):
        assert rollout.main([*words, *options, "--json", "a.json", "--film", "a.gif"]) == 0
        told.append(json.loads(Path("a.json").read_text()))
    plain, noisy = told
    assert noisy["env_options"] == {"sigma": 0.5} and "env_options" not in plain
    assert noisy["returns"] != plain["returns"] and filmed == [{}, {"sigma": 0.5}]
    capsys.readouterr()
    assert rollout.main([*words, "--env-option", "sigmas=1"]) == 1
    assert "sigmas" in capsys.readouterr().err


def test_a_picture_that_fails_loses_nothing(
    here: Path, address: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table, the numbers and the film were lost when the plot could not be drawn."""

    def broken(*_: object) -> None:
        raise RuntimeError("the font is gone")

    monkeypatch.setattr(plot, "save_plot", broken)
    monkeypatch.setattr(film, "save_film", lambda panels, path: path.write_text("film") and None)
    words = quick(address, "--model", "tiny", "--json", "out/a.json", "--plot", "out/a.png", "--film", "out/a.gif")
    assert rollout.main(words) == 1
    told = capsys.readouterr()
    assert "mean return" in told.out and "film: out/a.gif" in told.out
    assert told.err == "ada-rollout: not written: --plot out/a.png: the font is gone\n"
    assert len(json.loads(Path("out/a.json").read_text())["returns"]) == 2 and Path("out/a.gif").exists()


def test_what_cannot_be_written_is_told_before_anything_is_run(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three printed commands ran all their episodes and then failed for want of `out/`. No server is there, so none was asked."""
    Path("file").write_text("in the way")
    Path("folder.json").mkdir()
    rolled, judged = quick("127.0.0.1:1", "--wait", "0"), quick("127.0.0.1:1", "--wait", "0")
    for main, words, names in [
        (rollout.main, [*rolled, "--json", "file/a.json"], "--json file/a.json: cannot write there"),
        (rollout.main, [*rolled, "--json", "folder.json"], "--json folder.json is a directory"),
        (rollout.main, [*rolled, "--plot", "a.bmp"], "--plot must end in .png"),
        (rollout.main, [*rolled, "--plot", "file/a.png"], "--plot file/a.png"),
        (rollout.main, [*rolled, "--film", "a.mp4"], "--film must end in .gif"),
        (evaluate.main, [*judged, "--json", "file/a.json"], "--json file/a.json"),
        (collect, ["--env", "point-wind-s", "--quiet", "--out", "file/a.h5"], "--out file/a.h5"),
        (rollout.main, ["--env", "their_module:Theirs-v1", "--url", "127.0.0.1:1"], "Theirs-v1"),
        (evaluate.main, ["--env", "CartPole-v1", "--url", "127.0.0.1:1"], "Discrete(2)"),
    ]:
        assert main(words) in (1, 2)
        error = capsys.readouterr().err
        assert names in error and error.count("\n") == 1, error


def test_a_wait_is_a_number_of_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    """`--wait nan` waited for ever."""
    for wait in ("nan", "inf", "-1", "soon"):
        with pytest.raises(SystemExit):
            rollout.main(["--env", "point-wind-s", f"--wait={wait}"])
        assert "--wait" in capsys.readouterr().err


def test_models_and_settings_are_checked_before_the_first_episode(here: Path, address: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A wrong name as the last of several models was found out after all episodes of the others."""
    for words, name in [
        (["--models", "tiny,tinny"], "tinny"),
        (["--models", "tiny,cheetah-wind-s"], "cheetah-wind-s has 17 and 6"),
        (["--models", "tiny", "--set", "action_horizon=1,99"], "action_horizon"),
        (["--models", "tiny,,tiny"], "empty name"),
    ]:
        assert evaluate.main(quick(address, *words)) == 1
        told = capsys.readouterr()
        assert name in told.err and told.err.count("\n") == 1 and told.out == "", told


def test_what_was_finished_is_printed_when_the_rest_fails(
    here: Path, address: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in the second of two combinations lost the table of the first, and ended in a traceback."""
    import ada_diffuser.rollout as module

    run, calls = module.evaluate, []

    def once(*arguments: object) -> object:
        calls.append(arguments)
        if len(calls) > 1:
            raise KeyboardInterrupt
        return run(*arguments)

    monkeypatch.setattr(module, "evaluate", once)
    assert evaluate.main(quick(address, "--models", "tiny", "--set", "streaming=true,false", "--json", "a.json")) == 130
    told = capsys.readouterr()
    assert "| tiny | true |" in told.out and told.err.endswith("ada-evaluate: interrupted\n")
    assert len(json.loads(Path("a.json").read_text())) == 1


def test_a_log_gets_lines_and_no_bar(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Off a terminal `ada-collect` wrote one line of thousands of characters, with \\r between, and the others wrote nothing."""
    clock = iter(range(0, 10_000, 4))
    monkeypatch.setattr(progress.time, "monotonic", lambda: float(next(clock)))
    with progress.progress(40, "episodes", "episode") as advance:
        for _ in range(40):
            advance(1)
        for _ in range(9):
            advance(0)  # a search asks now and then, also while its policies are compared afterwards
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "episodes: 3 of 40 episodes (7 %), 0.188 a second, 3:17 left"
    assert not any("100 %" in line for line in lines), "what is over has no time left to tell"
    assert 5 < len(lines) < 20 and all(len(line) < 100 and "\r" not in line for line in lines)


def test_a_short_collection_leaves_no_progress_in_a_log(here: Path) -> None:
    command = [sys.executable, "-m", "ada_diffuser.commands.collect", "--env", "point-wind-s", "--episodes", "3", "--out", "a.h5"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stderr == ""


def test_results_reach_a_terminal_that_cannot_spell_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the locale has no plus-minus sign the table ended in a UnicodeEncodeError, after all episodes."""
    narrow = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", narrow)
    assert run_command("ada-rollout", lambda: print("-1.00 ± 0.10")) == 0
    narrow.seek(0)
    assert narrow.read() == "-1.00 ? 0.10\n"


def test_a_reader_that_leaves_is_no_traceback(here: Path) -> None:
    code = "from ada_diffuser.commands import run_command; import sys; sys.exit(run_command('x', lambda: print('a\\n' * 100000)))"
    done = subprocess.run(["bash", "-c", f"{sys.executable} -c {code!r} | head -1"], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("a\n", "")


def test_a_renderer_that_does_not_exist_is_one_sentence(here: Path) -> None:
    """`MUJOCO_GL=crayons` ended every command in a traceback out of MuJoCo's import."""
    command = [sys.executable, "-m", "ada_diffuser.commands.collect", "--env", "point-wind-s", "--episodes", "1", "--out", "a.h5"]
    done = subprocess.run(command, env={"MUJOCO_GL": "crayons", "PATH": "/usr/bin:/bin"}, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "crayons" in done.stderr and done.stderr.count("\n") == 1, done.stderr


def test_half_an_expert_is_named(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez("expert.npz", weights=np.zeros(3))
    whole = Path("expert.npz").read_bytes()
    Path("expert.npz").write_bytes(whole[: len(whole) // 2])
    assert collect(["--env", "cheetah-wind-s", "--quiet", "--out", "a.h5", "--expert", "expert.npz"]) == 2
    assert "expert.npz is not an expert" in capsys.readouterr().err


def test_a_json_file_is_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    save_json([1], path)
    with pytest.raises(TypeError):
        save_json([object()], path)
    assert json.loads(path.read_text()) == [1] and [file.name for file in tmp_path.iterdir()] == ["a.json"]
    check_output("--json", Path("/dev/stdout"))
