"""Recordings of a real server, replayed over the wire by `ada-rollout --replay`."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from server import BINARY, ROOT, running

from ada_diffuser import Client, Executed, SamplerOptions
from ada_diffuser.commands.rollout import main
from ada_diffuser.recording import Recording, replay

MODELS = ("--models", str(ROOT / "models"), "--default-model", "tiny")
#: What a session sees at a step.
STATES = np.sin(np.arange(400, dtype=np.float32).reshape(100, 4) * 0.37)


def lived(client: Client) -> int:
    """Sessions with chunks, latents that are drawn, rewards, a reset, a fork, an import: how many acts."""
    options = SamplerOptions(eta=0.7, latent="sample", action_horizon=2, kappa=float("inf"))
    with client.open_session("tiny", seed=3, options=options) as session, client.open_session("tiny", seed=4) as other:
        session.act(STATES[0])
        session.act(STATES[1], [Executed(reward=0.5), Executed(action=[0.1, 0.2])])
        session.act(STATES[2], nothing_executed=True)
        with session.fork(seed=9) as fork, client.import_session(session.export()) as imported:
            fork.act(STATES[3])
            imported.act(STATES[4], reward=[0.1, 0.2])
        session.reset(seed=8)
        session.act(STATES[5])
        for state in STATES[10:15]:
            other.act(state, reward=None)
    return 3 + 2 + 1 + 5


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording."""
    folder = tmp_path_factory.mktemp("recorded")
    with running(folder / "log", *MODELS, "--record", str(folder / "acts")) as address, Client(f"grpc://{address}") as client:
        assert lived(client) == 11
    (file,) = (folder / "acts").glob("*.adar")
    return file


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Another server, of one thread and other batches."""
    with running(
        tmp_path_factory.mktemp("other") / "log", *MODELS, "--set", "engine.workers=1", "--set", "engine.batch_len_max=3"
    ) as address:
        yield address


def exported(recording: Path) -> list[dict[str, Any]]:
    done = subprocess.run([str(BINARY), "replay", "--export", str(recording)], capture_output=True, text=True, check=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


def write(entries: list[dict[str, Any]], path: Path) -> Path:
    path.write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    return path


@pytest.mark.parametrize("face", ["grpc", "http"])
def test_the_same_answers_over_the_wire(
    recorded: Path, address: str, face: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "replay.json"
    words = ["--replay", str(recorded), "--url", address, "--face", face, "--json", str(out), "--programs", str(BINARY.parent)]
    assert main(words) == 0
    assert "equal: of 11 acts 11 are equal bit for bit" in capsys.readouterr().out
    told = json.loads(out.read_text())
    assert (told["verdict"], told["acts"], told["equal"], told["first"], told["not_compared"]) == ("equal", 11, 11, None, {})
    with Client(f"{face}://{address}") as client:
        assert not list(client.sessions()), "they were closed"


def test_a_changed_bit_is_named(recorded: Path, address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of actions, and of planned states, of which there is a digest."""
    for field, named in (("actions", "actions[0][1]"), ("planned_digest", "planned_states (digest)")):
        entries = exported(recorded)
        act = next(entry["act"] for entry in entries if "act" in entry and entry["act"]["step"] == 2)
        answer = act["answer"]["answer"]
        if field == "actions":
            answer["actions"][0][1] = float(np.nextafter(np.float32(answer["actions"][0][1]), np.float32(9)))
        else:
            answer["planned_digest"] = "AAAA" + answer["planned_digest"][4:]
        assert main(["--replay", str(write(entries, tmp_path / "changed.jsonl")), "--url", address]) == 1
        told = capsys.readouterr().out
        assert told.startswith("different: of 11 acts "), told
        assert f"session {act['session']}, episode 0, step 2: {named} was " in told
        assert "not compared: their session had gone another way" in told


def test_what_cannot_be_compared_is_counted(recorded: Path, address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A hurried act, a missing one, a model that is not served: no difference, and no success."""

    def without_second(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
        first = next(i for i, entry in enumerate(entries) if "act" in entry and entry["act"]["step"] == 2)
        return entries[:first] + entries[first + 1 :]

    def hurried(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
        next(entry["act"] for entry in entries if "act" in entry)["haste"] = {"bounds": [[0, 1]], "cut": None}
        return entries

    def foreign(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
        for entry in entries:
            if "stands" in entry:
                entry["stands"]["model_digest"] = "0" * 64
        return entries

    for change, why in ((without_second, "gap"), (hurried, "hurried"), (foreign, "no_model")):
        with Client(f"grpc://{address}") as client:
            path = write(change(exported(recorded)), tmp_path / "part.jsonl")
            done = replay(client, Recording.load(path))
        assert (done.verdict, done.different) == ("incomplete", 0) and set(done.not_compared) == {why}, done
        assert main(["--replay", str(path), "--url", address]) == 3
        assert capsys.readouterr().out.startswith("incomplete: ")


def test_a_file_that_is_none_says_so(recorded: Path, address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    header, *rest = exported(recorded)
    withheld = {"header": {**header["header"], "observations": False}}
    for text, words in (
        ("", "does not begin with a header"),
        ("nonsense\n", ":1: is no JSON"),
        ("[1]\n", ":1: is no entry of a recording"),
        (json.dumps(rest[0]), "does not begin with a header"),
        (json.dumps(withheld), "observations were withheld"),
    ):
        (tmp_path / "bad.jsonl").write_text(text)
        assert main(["--replay", str(tmp_path / "bad.jsonl"), "--url", address]) == 1
        assert words in capsys.readouterr().err
    with pytest.raises(ValueError, match="ada-server replay --export"):
        Recording.load(recorded)
    assert main(["--replay", str(recorded), "--url", address, "--programs", str(tmp_path)]) == 1
    assert "ada-server replay --export" in capsys.readouterr().err
    for words in (["--replay", str(recorded), "--env", "point-wind-s"], ["--replay", str(recorded), "--episodes", "3"], []):
        with pytest.raises(SystemExit):
            main(words)
    assert "does not go with --replay" in capsys.readouterr().err
