"""Measures what docs/reliability.md says, each scenario against a server process of its own."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from . import held, hostile, log, memory, newcomer, overload, schema
from .process import RELEASE, Row

SCENARIOS: dict[str, Callable[[], Iterator[Row]]] = {
    "memory": memory.measure,
    "held": held.measure,
    "newcomer": newcomer.measure,
    "log": log.measure,
    "hostile": hostile.measure,
    "schema": schema.measure,
    "overload": overload.measure,
}


def main() -> int:
    listed = "\n".join(f"  {name:10s}{sys.modules[measure.__module__].__doc__.strip()}" for name, measure in SCENARIOS.items())
    parser = argparse.ArgumentParser(
        prog="python -m tests.reliability",
        description=__doc__,
        epilog=f"scenarios:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="which of them (default: all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keeps the rows of these scenarios in FILE, in the place of older ones")
    flags = parser.parse_args()
    chosen = flags.scenarios or list(SCENARIOS)
    for name in chosen:
        if name not in SCENARIOS:
            parser.error(f"no scenario {name}: there are {', '.join(SCENARIOS)}")
    if not (RELEASE / "ada-server").exists():
        parser.error(f"no server in {RELEASE}: build it with `make reliability`")
    rows = []
    for name in chosen:
        for row in SCENARIOS[name]():
            print(row, flush=True)
            rows.append(row)
        if flags.json:
            _keep(flags.json, rows)
    return 0 if all(row.passes for row in rows) else 1


def _keep(file: Path, rows: list[Row]) -> None:
    measured = {row.scenario for row in rows}
    old = json.loads(file.read_text()) if file.exists() else []
    kept = [row for row in old if row["scenario"] not in measured]
    file.write_text(json.dumps([*kept, *(row.as_json() for row in rows)], indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    sys.exit(main())
