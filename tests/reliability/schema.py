"""Requests made from the served /openapi.json, and answers that it promises.

Needs schemathesis in .venv-reliability, which `make reliability-tools` makes. The path of the WebSocket is left out, which that
program does not speak, and so is one of its checks, that every body of the right types is taken: a state must have as many values as the
model takes, and no schema knows how many.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator

from .process import ROOT, Row, Server

PROGRAM = ROOT / ".venv-reliability" / "bin" / "st"
CASES = 100


def measure() -> Iterator[Row]:
    if not PROGRAM.exists():
        sys.exit(f"no schemathesis at {PROGRAM}: run `make reliability-tools`")
    with Server("models.default=tiny") as server:
        words = ["--exclude-path", "/v1/sessions/{id}/stream", "--exclude-checks", "positive_data_acceptance"]
        command = [str(PROGRAM), "run", f"{server.url}/openapi.json", "--seed", "1", "--max-examples", str(CASES), *words]
        told = subprocess.run(command, capture_output=True, text=True, check=False)
    cases = re.search(r"(\d+) generated", told.stdout)
    failures = re.search(r"(\d+) unique failures", told.stdout)
    if told.returncode:
        print(told.stdout)
    count = int(failures[1]) if failures else told.returncode
    yield Row("schema", f"failures of {cases[1] if cases else 'no'} generated requests", count, 0, "")
