"""Measures what docs/reliability.md says, each scenario against a server process of its own."""

from __future__ import annotations

import argparse
import json
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

from . import held, hostile, log, memory, newcomer, overload, recording, schema, speed, store
from .process import EXTRA, RELEASE, Row

SCENARIOS: dict[str, Callable[[], Iterator[Row]]] = {
    "memory": memory.measure,
    "held": held.measure,
    "newcomer": newcomer.measure,
    "log": log.measure,
    "hostile": hostile.measure,
    "schema": schema.measure,
    "overload": overload.measure,
    "recording": recording.measure,
    "speed": speed.measure,
    "store": store.measure,
    "million": store.measure_million,
}


def main() -> int:
    listed = "\n".join(f"  {name:10s}{sys.modules[measure.__module__].__doc__.strip()}" for name, measure in SCENARIOS.items())
    parser = argparse.ArgumentParser(
        prog="python -m tests.reliability",
        description=__doc__,
        epilog=f"scenarios:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO", help="which of them (default: all but speed and million)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keeps the rows of these scenarios in FILE, in the place of older ones")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of every server, e.g. a lax one")
    flags = parser.parse_args()
    EXTRA.extend(flags.set)
    chosen = flags.scenarios or [name for name in SCENARIOS if name not in ("speed", "million")]
    for name in chosen:
        if name not in SCENARIOS:
            parser.error(f"no scenario {name}: there are {', '.join(SCENARIOS)}")
    if not (RELEASE / "ada-server").exists():
        parser.error(f"no server in {RELEASE}: build it with `make reliability`")
    rows: list[Row] = []
    broken = [name for name in chosen if not _measure(name, rows, flags.json)]
    if broken:
        print(f"not measured to the end: {', '.join(broken)}", file=sys.stderr)
    return 0 if not broken and all(row.passes for row in rows) else 1


def _measure(name: str, rows: list[Row], file: Path | None) -> bool:
    """Appends the rows of one scenario; false if it broke, which costs its own rows, not those of the others."""
    measured = []
    try:
        for row in SCENARIOS[name]():
            print(row, flush=True)
            measured.append(row)
    except Exception:
        traceback.print_exc()
        return False
    rows.extend(measured)
    if file:
        _keep(file, rows)
    return True


def _keep(file: Path, rows: list[Row]) -> None:
    measured = {row.scenario for row in rows}
    old = json.loads(file.read_text()) if file.exists() else []
    kept = [row for row in old if row["scenario"] not in measured]
    file.write_text(json.dumps([*kept, *(row.as_json() for row in rows)], indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    sys.exit(main())
