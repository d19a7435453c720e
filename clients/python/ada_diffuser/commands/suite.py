"""`ada-suite`: methods x environments x training seeds from one file, and the report of what came of them."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ada_diffuser.commands import import_environments, run_command
from ada_diffuser.commands.programs import Programs, terminated_is_ended

if TYPE_CHECKING:
    from ada_diffuser.suite.cell import Cell, Places
    from ada_diffuser.suite.schedule import Outcome

_ABOUT = """\
Cells = methods x environments x training seeds, as a file says. Each cell collects its data (once), trains, serves, rolls out cold and
streaming, and probes; what it found goes to report/cells/SUITE/ENVIRONMENT/METHOD/seedN-MODE.json.

  ada-suite run report/suites/planners.toml      # stop it at any time; the same command goes on
  ada-suite run report/suites/planners.toml --only 'cheetah-vel-e/*' 'point-wind-s/*/seed0'
  ada-suite status report/suites/planners.toml
  ada-suite report                                          # report/README.md and its pictures, from the finished cells

A finished cell is done again when its part of the suite, its recipe or its data change, and only then. Cells that fail are told at the end
with their logs; the others go on. clients/python/README.md says what a suite may hold."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0; 1 with a line on stderr, or where a cell failed; 130 when interrupted."""
    arguments = _parser().parse_args(argv)
    return run_command("ada-suite", lambda: arguments.run(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("ada-suite", description=_ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    run = _command(commands, "run", _run, "do what is not done yet")
    _add_work(run)
    _add_only(run)
    run.add_argument("--jobs", type=int, default=2, metavar="N", help="cells at a time, each on one core (default 2)")
    run.add_argument("--json", action="store_true", help="print what became of the cells as JSON")
    one = _command(commands, "cell", _cell, "do one cell, here and now, to see what it says")
    one.add_argument("cell", metavar="ENVIRONMENT/METHOD/seedN", help="as status names it")
    _add_work(one)
    one.add_argument("--jobs", type=int, default=1, metavar="N", help="cells that share the machine meanwhile: its file says so")
    status = _command(commands, "status", _status, "which cells are done, and how long the others will take")
    _add_only(status)
    status.add_argument("--jobs", type=int, default=2, metavar="N", help="cells at a time (default 2)")
    status.add_argument("--json", action="store_true", help="print it as JSON")
    report = commands.add_parser("report", help="write tables and pictures of finished cells")
    report.set_defaults(run=_report)
    report.add_argument("suites", nargs="*", type=Path, metavar="SUITE.toml", help="(default: those in report/suites with a finished cell)")
    report.add_argument("--cells", type=Path, default=Path("report/cells"), metavar="DIR", help="finished cells (default report/cells)")
    report.add_argument("--out", type=Path, default=Path("report"), metavar="DIR", help="for README.md and PNGs (default report)")
    return parser


def _command(commands: Any, name: str, run: Any, about: str) -> argparse.ArgumentParser:
    """One that is about the cells of a suite."""
    parser: argparse.ArgumentParser = commands.add_parser(name, help=about)
    parser.set_defaults(run=run)
    parser.add_argument("suite", type=Path, metavar="SUITE.toml")
    parser.add_argument("--cells", type=Path, default=Path("report/cells"), metavar="DIR", help="finished cells (default report/cells)")
    parser.add_argument("--runs", type=Path, default=Path("runs/suite"), metavar="DIR", help="trainings and logs (default runs/suite)")
    parser.add_argument("--data", type=Path, default=Path("data"), metavar="DIR", help="collected data sets (default data)")
    return parser


def _add_only(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--only", nargs="+", metavar="CELL", help="of all cells these, in this order: ENVIRONMENT/METHOD/seedN, * is anything; in quotes"
    )


def _chosen(cells: Sequence[Cell], patterns: Sequence[str] | None) -> list[Cell]:
    """Those that a pattern fits, pattern by pattern; ValueError where one fits none."""
    if patterns is None:
        return list(cells)
    chosen: dict[str, Cell] = {}
    for pattern in patterns:
        fitting = {cell.name: cell for cell in cells if fnmatchcase(cell.name, pattern)}
        if not fitting:
            raise ValueError(f"--only {pattern}: there is no such cell; `ada-suite status` names them")
        chosen |= fitting
    return list(chosen.values())


def _add_work(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--programs", type=Path, metavar="DIR", help="where ada-server and ada-trainer are (default: PATH, target/release)")


def _load(arguments: argparse.Namespace) -> tuple[list[Cell], Places]:
    from ada_diffuser.suite.cell import Places, cells
    from ada_diffuser.suite.suite import Suite

    if getattr(arguments, "jobs", 1) < 1:
        raise ValueError("--jobs must be at least 1")
    all_cells = cells(Suite.load(arguments.suite))
    return _chosen(all_cells, getattr(arguments, "only", None)), Places(arguments.cells, arguments.runs, arguments.data)


def _run(arguments: argparse.Namespace) -> None:
    from ada_diffuser.suite.schedule import Durations, run

    cells, places = _load(arguments)
    Programs.find(arguments.programs)
    todo = [cell for cell in cells if cell.missing(places)]
    _check(todo)
    print(f"{arguments.suite}: {len(cells) - len(todo)} of {len(cells)} cells are done", file=sys.stderr, flush=True)
    with terminated_is_ended():
        outcome = run(todo, places, arguments.jobs, lambda cell: _command_of(arguments, cell), Durations.of(cells, places))
    if arguments.json:
        print(json.dumps(_as_json(arguments, len(cells), outcome), indent=1))
    for failure in outcome.failed:
        print(f"failed: {failure.cell.name}: {failure.reason}; see {failure.log}", file=sys.stderr)
    if outcome.failed:
        raise ValueError(f"{len(outcome.failed)} of {len(cells)} cells failed; the same command tries them again")


def _check(cells: Sequence[Cell]) -> None:
    """What would make a cell fail, so far as it can be known before the first of them begins."""
    from ada_diffuser.commands.collect import check_words

    environments = import_environments() if cells else None
    for world in {cell.environment.name: cell.environment for cell in cells}.values():
        environments.make(world.env, episode_steps=world.episode_steps, **world.options).close()
        if world.collect is not None:
            check_words(
                [word for flag, value in world.collect.items() for word in (f"--{flag}", str(value))], f"environments.{world.name}.collect"
            )


def _command_of(arguments: argparse.Namespace, cell: Cell) -> list[str]:
    """The command that does one cell as this one would."""
    words = [sys.executable, "-m", "ada_diffuser.commands.suite", "cell", str(arguments.suite), cell.name, "--jobs", str(arguments.jobs)]
    for flag in ("cells", "runs", "data", "programs"):
        value = getattr(arguments, flag)
        words += [] if value is None else [f"--{flag}", str(value)]
    return words


def _as_json(arguments: argparse.Namespace, total: int, outcome: Outcome) -> dict[str, Any]:
    return {
        "suite": str(arguments.suite),
        "cells": total,
        "finished": [cell.name for cell in outcome.finished],
        "failed": [{"cell": one.cell.name, "log": str(one.log), "reason": one.reason} for one in outcome.failed],
    }


def _cell(arguments: argparse.Namespace) -> None:
    from ada_diffuser.suite.work import work

    cells, places = _load(arguments)
    named = {cell.name: cell for cell in cells}
    if arguments.cell not in named:
        raise ValueError(f"{arguments.suite} has no cell {arguments.cell}; `ada-suite status` names them")
    with terminated_is_ended():
        work(named[arguments.cell], places, Programs.find(arguments.programs), arguments.jobs)


def _status(arguments: argparse.Namespace) -> None:
    from ada_diffuser.commands.progress import clock
    from ada_diffuser.suite.schedule import Durations

    cells, places = _load(arguments)
    missing = [(cell, cell.missing(places)) for cell in cells]
    todo = [cell for cell, modes in missing if modes]
    left = Durations.of(cells, places).left(todo, [], arguments.jobs)
    if arguments.json:
        told = [{"cell": cell.name, "missing": modes, "log": str(cell.log(places))} for cell, modes in missing]
        print(json.dumps({"suite": str(arguments.suite), "cells": told, "seconds_left": left and round(left, 1)}, indent=1))
        return
    for cell, modes in missing:
        print(f"to do  {cell.name}: {', '.join(modes)}" if modes else f"done   {cell.name}")
    about = "" if left is None or not todo else f", about {clock(left)} left"
    print(f"{len(cells) - len(todo)} of {len(cells)} cells are done{about}")


def _report(arguments: argparse.Namespace) -> None:
    from ada_diffuser.suite.report.page import write
    from ada_diffuser.suite.suite import Suite

    paths = arguments.suites or sorted(Path("report/suites").glob("*.toml"))
    if not paths:
        raise ValueError("there is no suite in report/suites; name one")
    for path in write([Suite.load(path) for path in paths], arguments.cells, arguments.out, only_begun=not arguments.suites):
        print(path)


if __name__ == "__main__":
    sys.exit(main())
