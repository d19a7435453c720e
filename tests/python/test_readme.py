"""Every example of every document, run as it is printed, in order, in a fresh checkout where everything is built already.

All fenced blocks are found and run, so a new one is tested without a word here. A comment before a block says what is different:

    <!-- given: env, state -->      it uses things of the reader's own; GIVEN makes them
    <!-- file: lift.py -->          the reader writes it to this file, which later blocks use
    <!-- run by .ci/run -->         another file runs it (and names it: the commands, or this document)
    <!-- dry run: reason -->        its commands, files and make targets must be there, but it is not run

What would take hours is shortened by SHORT_FLAGS and SHORT_RECIPES and nowhere else, and not in a document IN_FULL; `7777` becomes a
free port.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
import tomllib
from server import BINARY, ROOT

SHORT_FLAGS = {
    "ada-collect": "--episodes 4 --expert-searches 1 --expert-iterations 1",
    "ada-rollout": '$([ "$1" = --replay ] || echo --episodes 2 --episode-steps 12)',
    "ada-evaluate": "--episodes 2 --episode-steps 12",
    "ada-suite": "",
}
"""Added to every call of a command; the last word on a flag counts."""

PLACE_FLAGS = {
    "ada-rollout": "--url 127.0.0.1:7777",
    "ada-evaluate": f"--url 127.0.0.1:7777 --programs {BINARY.parent}",
    "ada-suite": f"$([ $1 != run ] || echo --programs {BINARY.parent})",
}
"""Where the server is; and the programs themselves, for a command that starts a server of its own beside the reader's."""

IN_FULL = ("docs/simulator.md",)
"""Documents whose commands are small enough to be run to their end, so that what they promise comes out."""

SHORT_RECIPES = [(r"^steps = \d+", "steps = 2"), (r"\b(filter|successor_state) = [\d.]+", r"\1 = 1000.0")]
"""Replaced in every recipe: two steps of training, and a gate that lets them pass."""

SHORT_WORDS = (r"\b(stages\.\w+\.steps=)\d+", r"\g<1>2")
"""The same of steps that a command, or a file that the reader writes, asks for itself."""

GIVEN = {
    "env": "import gymnasium; env = gymnasium.make('ada_diffuser.environments:ada/CheetahWind-S-v0')",
    "client": "from ada_diffuser import Client; client = Client('grpc://127.0.0.1:7777')",
    "session": "from ada_diffuser import Client; session = Client('grpc://127.0.0.1:7777').open_session('tiny', seed=1)",
    "state": "state = [0.1, 0.2, 0.0, 0.0]",
    "a0": "a0 = [0.1, 0.2]",
    "s1": "s1 = [0.1, 0.3, 0.0, 0.0]",
    "a1": "a1 = [0.0, 0.1]",
    "brokers": "from ada_diffuser import ChunkBroker; brokers = [ChunkBroker(client.open_session('tiny')) for _ in range(3)]",
    "states": "states = [[0.1, 0.2, 0.0, 0.0]] * 3",
}

SAYS = {
    "README.md": [
        *('"actions":', '"latent_mean":', '"evaluations":8', '"step":2', '"cheetah-wind-s"'),
        *('"committed_step":1', '"replayed":true'),
    ],
    "clients/http/README.md": ['"committed_step":1', '"replayed":true'],
    "docs/identification.md": [
        "posterior, from exact probabilities: off by less than 1e-12: True",
        "eigenvalues are the k of both contexts: True",
        "from  1000000 windows: off by 0.027",
        "singular values without one: [0.2316 0.     0.    ]",
        "eigenvalues with the same k: [[1.0, 1.0], [1.0, 1.0], [1.0, 1.0]]",
        "windows differ by less than 1e-12: True",
        "posteriors differ by up to 0.13",
        "least error of the latent at shift",
        '"evidence":"filter"',
    ],
    "docs/reliability.md": ["acts, bit for bit, in", "are equal bit for bit, 0 are not"],
    "docs/simulator.md": [
        "data/lift.h5: 100 episodes, 10000 steps; return -9.67 +- 0.36, median -9.03, 0 failed",
        "denoise step 600 of 600",
        "lift-seed0@",
        "failures            0 of 64",
        "film: out/lift.gif",
    ],
}
"""Words that the answers of a document's examples must hold."""

DOCUMENTS = subprocess.run(
    ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True
).stdout.split()


@dataclass(frozen=True)
class Example:
    document: str
    language: str
    text: str
    #: The comment before it: `given`, `file`, `run by`, `dry run`, or nothing; and its words.
    mark: str
    words: str


def examples(document: str) -> list[Example]:
    text = (ROOT / document).read_text(encoding="utf-8")
    fence = r"(?:<!-- (given|file|run by|dry run):? ?(.*?) -->\n)?^( *)```(.*)\n((?s:.*?))^ *```$"
    found = re.findall(fence, text, re.MULTILINE)
    return [
        Example(document, language, re.sub(rf"^{indent}", "", body, flags=re.MULTILINE), mark, words)
        for mark, words, indent, language, body in found
    ]


class Checkout:
    """A clone with everything built: what is tracked and what was built, the commands shortened, and none of a run's outputs."""

    def __init__(self, folder: Path, *, shortened: bool) -> None:
        self.folder, self.shortened = folder, shortened
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = str(free.getsockname()[1])
        for path in ROOT.iterdir():
            if path.name not in ("target", "models", "report", "data", "runs", "out", "shipped") and not path.name.startswith("."):
                (folder / path.name).symlink_to(path)
        shutil.copytree(ROOT / "report", folder / "report")
        self._models()
        self._commands()
        self.path = f"{folder / '.venv/bin'}:{folder / 'target/release'}:{os.environ['PATH']}"

    def _models(self) -> None:
        shutil.copytree(ROOT / "models", self.folder / "models")
        for recipe in self.folder.glob("models/*/*.toml"):
            text = recipe.read_text(encoding="utf-8")
            for pattern, short in SHORT_RECIPES:
                text = re.sub(pattern, short, text, flags=re.MULTILINE)
            recipe.write_text(text, encoding="utf-8")

    def _commands(self) -> None:
        scripts, built = self.folder / ".venv/bin", self.folder / "target/release"
        scripts.mkdir(parents=True)
        built.mkdir(parents=True)
        for name, flags in SHORT_FLAGS.items():
            module = f"ada_diffuser.commands.{name.removeprefix('ada-')}"
            added = f"{flags if self.shortened else ''} {PLACE_FLAGS.get(name, '')}"
            self._script(scripts / name, f'exec {sys.executable} -m {module} "$@" {added}')
        self._script(scripts / "cargo", "exit 0")
        (scripts.parent / ".ready").touch()
        (built / "ada-trainer").symlink_to(BINARY.with_name("ada-trainer"))
        # In the background, one at a time, and back when it is ready: as after a look at its log and a second terminal.
        pid, log = self.folder / "server.pid", self.folder / "server.log"
        self._script(
            built / "ada-server",
            f'if [ "$1" = replay ]; then exec {BINARY} "$@"; fi\n'
            f"if [ -f {pid} ]; then kill -9 $(cat {pid}); sleep 0.3; fi\n"
            f'ADA__SERVER__LISTEN=127.0.0.1:7777 {BINARY} "$@" >>{log} 2>&1 &\n'
            f"echo $! >{pid}\n"
            "for i in $(seq 300); do curl -sf http://127.0.0.1:7777/readyz >/dev/null && exit 0; kill -0 $! || exit 1; sleep 0.2; done\n"
            "exit 1",
        )

    def _script(self, path: Path, body: str) -> None:
        path.write_text(f"#!/bin/sh\n{body.replace('7777', self.port)}\n", encoding="utf-8")
        path.chmod(0o755)

    def run(self, command: list[str]) -> str:
        """Both streams of a command that must succeed."""
        environment = {**os.environ, "PATH": self.path}
        for name in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS"):  # those of a `make test` around this one
            environment.pop(name, None)
        command = [self.short(word).replace("7777", self.port) for word in command]
        done = subprocess.run(command, cwd=self.folder, env=environment, capture_output=True, text=True, timeout=500, check=False)
        assert done.returncode == 0, f"{command[-1]}\nended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
        return done.stdout + done.stderr

    def short(self, text: str) -> str:
        """What is asked for in it, in two steps."""
        return re.sub(*SHORT_WORDS, text) if self.shortened else text

    def stop_server(self) -> None:
        with suppress(FileNotFoundError, ProcessLookupError):
            os.kill(int((self.folder / "server.pid").read_text()), signal.SIGKILL)


@pytest.fixture
def checkout(tmp_path: Path, document: str) -> Iterator[Checkout]:
    checkout = Checkout(tmp_path, shortened=document not in IN_FULL)
    yield checkout
    checkout.stop_server()


def run(example: Example, checkout: Checkout) -> str:
    """What the example printed."""
    assert example.mark != "given" or example.language == "python"
    match example.mark, example.language:
        case "file", _:
            path = checkout.folder / example.words
            assert not path.exists(), f"{path.name} is there already"
            path.write_text(checkout.short(example.text), encoding="utf-8")
        case "run by", _:
            runner = (ROOT / example.words).read_text(encoding="utf-8")
            commands = [line.split("#")[0].strip() for line in example.text.splitlines()]
            assert example.document in runner or all(command in runner for command in commands), f"{example.words} does not run {example}"
        case "dry run", "sh":
            dry_run(example, checkout)
        case _, "sh":
            return checkout.run(["bash", "-euo", "pipefail", "-c", example.text])
        case _, "python":
            given = [GIVEN[name.strip()] for name in example.words.split(",")] if example.mark == "given" else []
            return checkout.run([sys.executable, "-c", "\n".join([*given, example.text])])
        case _, "json":
            json.loads(example.text)
        case _, "toml":
            tomllib.loads(example.text)
        case _, "text":
            pass
        case _, other:
            pytest.fail(f"{example.document}: a block of {other!r}: say sh, python, json, toml or text\n{example.text}")
    return ""


def dry_run(example: Example, checkout: Checkout) -> None:
    """Commands, modules, make targets and files exist."""
    assert example.words, f"{example.document}: a dry run without a reason"
    for line in example.text.replace("\\\n", " ").splitlines():
        program, *words = shlex.split(line, comments=True)
        assert shutil.which(program, path=checkout.path), line
        if program == "make":
            checkout.run(["make", "-n", *words])
            continue
        if "-m" in words:
            assert importlib.util.find_spec(words[words.index("-m") + 1]), line
        for word in words:
            if "/" in word and not word.startswith("-"):
                assert list(checkout.folder.glob(re.sub(r"\[\w+\]$", "", word))), f"{line}: no {word}"


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_example_runs_as_printed(document: str, checkout: Checkout) -> None:
    """`gymnasium.make` failed for want of an import, three commands for want of `out/`; only two blocks of one file were run."""
    found = examples(document)
    if any(example.language in ("sh", "python") for example in found):
        checkout.run(["ada-server"])
    told = "\n".join([run(example, checkout) for example in found])
    for words in SAYS.get(document, []):
        assert words in told, f"{words} is not in {told}"


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_example_is_fenced(document: str) -> None:
    """So that all are found: an indented block, or a fence that is not closed, would be passed over."""
    text = (ROOT / document).read_text(encoding="utf-8")
    assert len(re.findall(r"^ *```", text, re.MULTILINE)) == 2 * len(examples(document))
    prose = re.sub(r"^ *```(?s:.*?)^ *```$", "", text, flags=re.MULTILINE)
    indented = re.findall(r"\n\n(?:    |\t)\S.*", prose)
    assert not indented, f"{document}: fence these blocks and say their language: {indented}"
