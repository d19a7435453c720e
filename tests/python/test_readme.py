"""The README's curl and Python examples, run as they stand against the server and the checkpoints that ship."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator

import pytest
from server import ROOT, running

from ada_diffuser import environments


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running(tmp_path_factory.mktemp("server") / "log") as address:
        yield address


def examples(language: str, path: str = "README.md") -> list[str]:
    blocks = re.findall(rf"```{language}\n(.*?)```", (ROOT / path).read_text(), re.DOTALL)
    assert blocks, f"no {language} example in {path}"
    return blocks


def test_curl(address: str) -> None:
    for script in examples("sh"):
        script = script.replace("localhost:7777", address)
        answer = subprocess.run(["bash", "-euo", "pipefail", "-c", script], capture_output=True, text=True, timeout=60)
        assert answer.returncode == 0, answer.stderr
        for word in ('"actions":', '"latent_mean":', '"evaluations":8', '"step":2', '"cheetah-wind-s"'):
            assert word in answer.stdout, f"{word} is not in {answer.stdout}"


def test_python(address: str) -> None:
    env = environments.make("cheetah-wind-s")
    for script in examples("python"):
        names = {"env": env}
        exec(script.replace("127.0.0.1:7777", address), names)
        assert names["done"] is True
