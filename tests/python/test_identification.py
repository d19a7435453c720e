"""What was found where: the rows of `ada-trainer probe --json`, and `report/identification.json`, which is many of them."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Iterator
from typing import Any

import pytest
from server import BINARY, ROOT

REPORT = ROOT / "report/identification.json"
AGES = [None, [0, 10], [10, 30], [30, 80], [80, None]]
READOUT = {"standard_error", "episodes"}
"""Keys more of a row that `ada-evaluate --readout` found: the agent's own episodes have no ceiling, and an error over them."""
STATE = {"state", "mse_with_state"}
"""Keys more of a row of a filter: the state alone, and beside the latent. Rows from before these were measured lack them."""
KEYS = {
    "environment",
    "seed",
    "method",
    "where",
    "evidence",
    "ahead",
    "looks",
    "block_len",
    "age",
    "mse",
    "ceiling",
    "ceiling_without_actions",
}


def check(row: dict[str, Any]) -> None:
    readout = row.keys() >= READOUT
    beside_state = row["evidence"] == "filter" and not readout and row.keys() >= STATE
    assert set(row) == KEYS | (READOUT if readout else set()) | (STATE if beside_state else set())
    assert isinstance(row["environment"], str) and isinstance(row["method"], str) and row["environment"] and row["method"]
    assert isinstance(row["seed"], int) and row["seed"] >= 0
    assert row["where"] in ("held_out", "own_rollouts")
    assert row["evidence"] in ("filter", "successor", "prior")
    assert isinstance(row["ahead"], int) and (row["ahead"] > 0) == (row["evidence"] == "prior")
    assert (row["looks"], row["block_len"]) == ("running", None) or (row["looks"] == "block" and row["block_len"] >= 0)
    assert row["age"] in ([*AGES, [50, None]] if readout else AGES)
    for error in ("mse", "ceiling", "ceiling_without_actions", *(STATE if beside_state else ())):
        assert row[error] is None or (isinstance(row[error], float | int) and math.isfinite(row[error]) and row[error] >= 0)


def name(row: dict[str, Any]) -> str:
    return json.dumps({key: row[key] for key in KEYS - {"mse", "ceiling", "ceiling_without_actions"}}, sort_keys=True)


def number(error: float | None) -> str:
    return "-" if error is None else f"{error:.3f}".removeprefix("0")


def told(row: dict[str, Any]) -> str:
    if "standard_error" in row:
        return f"{number(row['mse'])} ± {number(row['standard_error'])}"
    return " / ".join(number(row[error]) for error in ("mse", "ceiling", "ceiling_without_actions"))


def tables(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Lines of the tables of docs/identification.md, at the look that each model has for itself."""
    models = dict.fromkeys((row["environment"], row["method"], row["seed"], row["where"]) for row in rows)
    for model in models:
        own = [row for row in rows if (row["environment"], row["method"], row["seed"], row["where"]) == model]
        longest = max(row["block_len"] or 0 for row in own)
        own = [row for row in own if row["block_len"] in (longest, None)]
        name = f"{model[1]}, seed {model[2]}"
        for evidence in ("filter", "successor"):
            cells = [told(row) for row in own if row["evidence"] == evidence]
            if cells:
                yield f"| {name}, {evidence} | {' | '.join(cells)} |"
        ahead = [told(row) for row in own if row["evidence"] == "prior" and row["age"] is None]
        if ahead:
            yield f"| {name} | {' | '.join(ahead)} |"


def test_the_document_shows_them() -> None:
    document = (ROOT / "docs/identification.md").read_text(encoding="utf-8").splitlines()
    missing = [line for line in tables(json.loads(REPORT.read_text(encoding="utf-8"))) if line not in document]
    assert not missing, "docs/identification.md lacks\n" + "\n".join(missing)


def test_what_was_found_has_the_rows_that_the_probe_prints() -> None:
    rows = json.loads(REPORT.read_text(encoding="utf-8"))
    for row in rows:
        check(row)
    assert len({name(row) for row in rows}) == len(rows), "no row stands there twice"
    shipped = {"point-wind-s", "cheetah-vel-e", "cheetah-wind-s"}
    own = {row["environment"] for row in rows if row["method"] in shipped and row["age"] is None and row["mse"] is not None}
    assert own >= shipped


@pytest.mark.parametrize("change", [{"evidence": "wind"}, {"age": [0, 11]}, {"mse": -1.0}, {"ahead": 1}, {"looks": "running"}, {"r2": 0.5}])
def test_a_row_of_another_form_is_seen(change: dict[str, Any]) -> None:
    row = next(row for row in json.loads(REPORT.read_text(encoding="utf-8")) if row["evidence"] == "filter" and row["looks"] == "block")
    with pytest.raises(AssertionError):
        check(row | change)


def test_the_probe_prints_these_rows(tmp_path: Any) -> None:
    trainer = str(BINARY.with_name("ada-trainer"))
    data = "tests/golden/data_good.h5"
    subprocess.run([trainer, "run", "tests/golden/small.toml", "--out", str(tmp_path / "out")], cwd=ROOT, check=True, timeout=300)
    probe = [trainer, "probe", str(tmp_path / "out"), data, "--ahead", "2", "--json", "--environment", "nowhere", "--own-rollouts"]
    printed = subprocess.run(probe, capture_output=True, text=True, cwd=ROOT, timeout=300, check=True).stdout
    rows = json.loads(printed)
    for row in rows:
        check(row)
    assert {row["environment"] for row in rows} == {"nowhere"} and {row["where"] for row in rows} == {"own_rollouts"}
    ahead = [(row["evidence"], row["ahead"], row["block_len"]) for row in rows if row["age"] is None]
    assert ahead == [(e, 0, n) for n in (1, 2, 3) for e in ("filter", "successor")] + [("prior", 1, 3), ("prior", 2, 3)]
    assert all((row.keys() >= STATE) == (row["evidence"] == "filter" and row["block_len"] == 3) for row in rows if row["age"] is None)
    assert printed.count("\n") == len(rows) + 2, "a row a line"
