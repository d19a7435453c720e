"""The server that the tests of the client share."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest
from server import ROOT, running


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """`host:port` of a server that runs for this module, and must end by itself when told to."""
    folder = tmp_path_factory.mktemp("server")
    shutil.copytree(ROOT / "models/tiny", folder / "models/tiny")
    with running(folder / "log", "--models", str(folder / "models"), "--default-model", "tiny") as address:
        yield address
