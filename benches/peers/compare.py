"""Holds this software against what a user would write today, PyTorch and a Python policy server, in one run on the same cores.

    make bench-peers                                    # sets everything up; the whole table takes about half an hour
    make bench-peers PEERS="--only serve,churn --quick" # a part of it, or a first look
    PEERS_VENV=/path/to/venv make bench-peers           # with a virtual environment that has the requirements already

Each figure is the median over turns; theirs and ours take turns (A B A B ...), so that a slow minute of the machine hits both.
PyTorch counts with the best of its modes (eager, jit, compile). An act of the group `act` is asked of our server over the wire, and of
PyTorch as a function. Prints one Markdown table. Nothing else should run on the machine.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import machine
from processes import MAKE_RANDOM, NotMeasured
from trials import GROUPS, NARROW, Figures, Goal, Settings, Trial, trials


@dataclass(frozen=True)
class Row:
    """One row of the table, as it is written to --json."""

    group: str
    name: str
    unit: str
    theirs_mode: str | None
    theirs: float | None
    ours_mode: str | None
    ours: float | None
    score: float | None
    target: float
    kind: str
    reached: bool | None
    not_measured: str | None
    theirs_turns: list[Figures]
    ours_turns: list[Figures]
    others_busy: float = 0.0


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0, or 1 if something could not be measured (a missed target is a result)."""
    arguments = _parser().parse_args(argv)
    # A termination unwinds as Ctrl-C does, so that no server is left behind.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    # torch.compile by the process itself: workers that outlive it would be taken for others at work.
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    if arguments.json:  # now, and not after half an hour of measuring
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
    cores = machine.pin(arguments.cores)
    facts = machine.describe(cores)
    _say(f"{facts['processor']}, cores {facts['cores']}, PyTorch {facts['torch']}")
    with tempfile.TemporaryDirectory() as models:
        settings = _settings(arguments, Path(models))
        chosen = [trial for trial in trials() if trial.group in arguments.only]
        rows = []
        for n, trial in enumerate(chosen, start=1):
            watch = machine.Watch(cores)
            measured = _measure(trial, settings, arguments.turns, f"{n}/{len(chosen)}")
            rows += [replace(row, others_busy=watch.others()) for row in measured]
            if arguments.json:
                report = {"machine": facts, "turns": arguments.turns, "rows": [asdict(row) for row in rows]}
                arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    print(_table(rows, {goal.text: goal for trial in chosen for goal in trial.goals}))
    return int(any(row.not_measured for row in rows))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", type=_groups, default=list(GROUPS), metavar="A,B", help=f"parts of the table: {', '.join(GROUPS)}")
    parser.add_argument("--quick", action="store_true", help="one short turn without torch.compile: does it work?")
    parser.add_argument("--turns", type=int, metavar="N", help="turns of each side (default 3; 1 with --quick)")
    parser.add_argument("--seconds", type=float, metavar="S", help="of each load (default 5; 1 with --quick)")
    parser.add_argument("--face", choices=["unary", "stream", "batch"], default="stream", help="how our clients speak (default stream)")
    parser.add_argument("--cores", type=int, default=2, metavar="N", help="cores that everything shares (default 2)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the same with every turn, for programs")
    return parser


def _groups(text: str) -> list[str]:
    groups = text.split(",")
    if unknown := set(groups) - set(GROUPS):
        raise argparse.ArgumentTypeError(f"there is no {', '.join(sorted(unknown))}; there are {', '.join(GROUPS)}")
    return groups


def _settings(arguments: argparse.Namespace, models: Path) -> Settings:
    quick = arguments.quick
    arguments.turns = arguments.turns or (1 if quick else 3)
    seconds = arguments.seconds or (1.0 if quick else 5.0)
    if {"serve", "memory", "churn"} & set(arguments.only):
        if not MAKE_RANDOM.exists():
            sys.exit(f"{MAKE_RANDOM} is not there: `make bench-peers` builds it")
        subprocess.run([MAKE_RANDOM, "--out", models / "narrow", "--widths", NARROW], check=True, stdout=subprocess.DEVNULL)
    modes = "eager,jit" if quick else "eager,jit,compile"
    return Settings(models, seconds, 0.5 if quick else 2.0, modes, 30 if quick else 100, arguments.face)


def _measure(trial: Trial, settings: Settings, turns: int, which: str) -> list[Row]:
    """Both sides by turns; a trial that cannot be measured says why in its rows."""
    theirs: list[Figures] = []
    ours: list[Figures] = []
    reason = None
    try:
        with ExitStack() as stack:
            _say(f"[{which}] {trial.name}")
            ask_theirs, ask_ours = trial.prepare(settings, stack)
            for turn in range(1, turns + 1):
                theirs.append(ask_theirs())
                ours.append(ask_ours())
                _say(f"[{which}]   turn {turn}/{turns}: {_brief(theirs[-1])} | {_brief(ours[-1])}")
    except NotMeasured as error:
        reason = str(error)
        _say(f"[{which}]   not measured: {reason}")
    return [_row(trial, goal, theirs, ours, reason) for goal in trial.goals]


def _row(trial: Trial, goal: Goal, theirs: list[Figures], ours: list[Figures], reason: str | None) -> Row:
    their_mode, their_value = _best(theirs, goal)
    our_mode, our_value = _best(ours, goal)
    score = None
    if reason is None and our_value is not None:
        try:
            score = goal.score(their_value, our_value)
        except NotMeasured as error:
            reason = str(error)
    reached = None if score is None else goal.reached(score)
    sides = (their_mode, their_value, our_mode, our_value)
    return Row(trial.group, goal.text, goal.unit, *sides, score, goal.target, goal.kind, reached, reason, theirs, ours)


def _best(turns: list[Figures], goal: Goal) -> tuple[str | None, float | None]:
    """The best mode by its median over the turns."""
    modes = {mode for figures in turns for mode in figures}
    medians = {mode: statistics.median(figures[mode][goal.figure] for figures in turns if mode in figures) for mode in modes}
    if not medians:
        return None, None
    mode = (max if goal.kind == "times more" else min)(medians, key=lambda mode: medians[mode])
    return mode, medians[mode]


def _table(rows: Sequence[Row], goals: dict[str, Goal]) -> str:
    heads = ["", "PyTorch, best mode", "ours", "ratio", "target", "reached"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in rows:
        goal = goals[row.name]
        sign = "at most" if row.kind.endswith("at most") else "at least"
        ratio = "" if row.score is None or row.kind == "at most" else goal.show(row.score)
        reached = "not measured" if row.reached is None else "yes" if row.reached else "no"
        theirs, ours = (_cell(value, row.unit, mode) for value, mode in ((row.theirs, row.theirs_mode), (row.ours, row.ours_mode)))
        lines.append(f"| {row.name} | {theirs} | {ours} | {ratio} | {sign} {goal.show(row.target)} | {reached} |")
    if (busiest := max((row.others_busy for row in rows), default=0.0)) > machine.BUSY:
        lines.append(f"\nOthers used up to {100 * busiest:.0f} % of the cores meanwhile: do not trust these figures.")
    lines += [f"\nNot measured: {reason}" for reason in sorted({row.not_measured for row in rows if row.not_measured})]
    return "\n".join(lines)


def _cell(value: float | None, unit: str, mode: str | None) -> str:
    if value is None:
        return ""
    # Three significant figures.
    digits = max(0, 2 - math.floor(math.log10(value))) if value > 0 else 0
    return f"{value:.{digits}f} {unit}" + ("" if mode in (None, "ada") else f" ({mode})")


def _brief(figures: Figures) -> str:
    return "; ".join(f"{mode} " + ", ".join(f"{name} {value:.3f}" for name, value in line.items()) for mode, line in figures.items()) or "-"


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
