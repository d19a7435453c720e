"""Cells at work, two at a time: which is next, how far they are, how long the rest will take, and what failed."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

from ada_diffuser.commands.programs import STOP_S, leashed
from ada_diffuser.commands.progress import clock
from ada_diffuser.suite.cell import Cell, Places, found

_POLL_S = 0.2
#: Off a terminal, a line at least this often.
_QUIET_S = 60.0
#: Numbers do not depend on threads, and two cells on two cores have one each.
_ONE_THREAD = dict.fromkeys(("RAYON_NUM_THREADS", "CANDLE_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


@dataclass(frozen=True)
class Failure:
    """A cell that came to nothing."""

    cell: Cell
    log: Path
    #: The last that was said of it.
    reason: str


@dataclass(frozen=True)
class Outcome:
    """What became of a suite."""

    finished: list[Cell]
    failed: list[Failure]


@dataclass
class _Worker:
    """A cell in a process of its own, which is the parent of all that it runs."""

    cell: Cell
    log: Path
    process: subprocess.Popen[bytes]
    #: That it, and all that it runs, is bound to.
    core: int | None
    started: float = field(default_factory=lambda: time.monotonic())

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.started

    def told(self, lines: int = 1) -> str:
        """The last of its log."""
        return " / ".join(tail(self.log, lines))


#: The command that does one cell.
Command = Callable[[Cell], Sequence[str]]


def run(cells: Sequence[Cell], places: Places, jobs: int, command: Command, durations: Durations) -> Outcome:
    """Does the cells, `jobs` at a time. An exception (Ctrl-C) stops those at work, which keep what they have."""
    board = _Board(len(cells), durations, jobs, places)
    waiting, workers, outcome = list(cells), list[_Worker](), Outcome([], [])
    try:
        while waiting or workers:
            while len(workers) < jobs and (cell := next_cell(waiting, [worker.cell for worker in workers], places)):
                waiting.remove(cell)
                workers.append(_start(cell, places, command, _free_core([worker.core for worker in workers])))
            for worker in [one for one in workers if one.process.poll() is not None]:
                workers.remove(worker)
                board.ended(worker, _settle(worker, places, outcome), waiting, workers)
            board.show(waiting, workers)
            time.sleep(_POLL_S)
    finally:
        board.clear()
        _stop(workers)
    return outcome


def next_cell(waiting: Sequence[Cell], at_work: Sequence[Cell], places: Places) -> Cell | None:
    """The first whose training nobody is at; where all would only wait for another one, none."""
    busy = {cell.training(places) for cell in at_work}
    return next((cell for cell in waiting if cell.training(places) not in busy), None)


def _free_core(taken: Sequence[int | None]) -> int | None:
    """One that this process may use and no worker has: a training takes all that it sees, and two of them would wait for each other."""
    usable = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    return next((core for core in usable if core not in taken), None)


def _start(cell: Cell, places: Places, command: Command, core: int | None) -> _Worker:
    log = cell.log(places)
    log.parent.mkdir(parents=True, exist_ok=True)
    # In a session of its own: Ctrl-C ends this program, which then stops its cells.
    with log.open("ab") as sink:
        process = subprocess.Popen(
            leashed(command(cell)),
            stdin=subprocess.DEVNULL,
            stdout=sink,
            stderr=sink,
            env={**os.environ, **_ONE_THREAD},
            start_new_session=True,
        )
    if core is not None:
        os.sched_setaffinity(process.pid, {core})
    return _Worker(cell, log, process, core)


def _settle(worker: _Worker, places: Places, outcome: Outcome) -> str | None:
    """Notes how it ended; the reason where it failed."""
    code = worker.process.returncode
    if code == 0 and not worker.cell.missing(places):
        outcome.finished.append(worker.cell)
        return None
    reason = f"killed by signal {-code}" if code < 0 else worker.told(2) or f"ended with {code}"
    outcome.failed.append(Failure(worker.cell, worker.log, reason))
    return reason


def _stop(workers: Sequence[_Worker]) -> None:
    """Each of them, and with it what it runs: a training writes its state down first."""
    for worker in workers:
        worker.process.terminate()
    end = time.monotonic() + 2 * STOP_S
    for worker in workers:
        try:
            worker.process.wait(max(0.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            worker.process.kill()
            worker.process.wait()


def tail(log: Path, lines: int) -> list[str]:
    """The last lines of a log, however long it is."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - 4096))
        text = file.read().decode(errors="replace").replace("\r", "\n")
    return [line.strip() for line in text.strip().splitlines()[-lines:]]


@dataclass
class Durations:
    """Seconds that finished cells took, by environment and method."""

    known: dict[tuple[str, str], list[float]]

    @classmethod
    def of(cls, cells: Sequence[Cell], places: Places) -> Durations:
        """As the files of those that are finished have them."""
        durations = cls({})
        for cell in cells:
            durations.note(cell, [file for mode in cell.method.modes if (file := found(cell.file(places, mode)))])
        return durations

    def note(self, cell: Cell, files: Sequence[Mapping[str, Any]]) -> None:
        """What one cell found."""
        if files:
            seconds = files[0]["train_seconds"] + sum(file["rollout_seconds"] for file in files)
            self.known.setdefault((cell.environment.name, cell.method.name), []).append(seconds)

    def of_cell(self, cell: Cell) -> float | None:
        """What it should take: as its like did, else as this method or environment did, else as all did."""
        environment, method = cell.environment.name, cell.method.name
        for fits in (
            lambda e, m: (e, m) == (environment, method),
            lambda e, m: m == method,
            lambda e, m: e == environment,
            lambda e, m: True,
        ):
            like = [seconds for (e, m), all_seconds in self.known.items() if fits(e, m) for seconds in all_seconds]
            if like:
                return fmean(like)
        return None

    def left(self, waiting: Sequence[Cell], at_work: Sequence[tuple[Cell, float]], jobs: int) -> float | None:
        """Until all are done; `at_work` with the seconds that they have taken already. None where nothing is known."""
        whole = [self.of_cell(cell) for cell in waiting]
        parts = [(self.of_cell(cell), seconds) for cell, seconds in at_work]
        if not self.known:
            return None
        rests = [max((seconds or 0.0) - spent, spent / 10) for seconds, spent in parts]  # what is late already is nearly done
        return max([(sum(rests) + sum(seconds or 0.0 for seconds in whole)) / jobs, *rests])


class _Board:
    """Says how far the suite is, on stderr: a line as each cell ends; between them one that is written over, or in a log one a minute."""

    def __init__(self, total: int, durations: Durations, jobs: int, places: Places) -> None:
        self._total, self._durations, self._jobs, self._places = total, durations, jobs, places
        self._ended = 0
        self._live = sys.stderr.isatty()
        self._said = time.monotonic()

    def ended(self, worker: _Worker, reason: str | None, waiting: Sequence[Cell], workers: Sequence[_Worker]) -> None:
        self._ended += 1
        files = [found(worker.cell.file(self._places, mode)) or {} for mode in worker.cell.method.modes]
        if reason is None:
            self._durations.note(worker.cell, files)
        what = f"failed: {reason}" if reason else ", ".join(f"{one['mode']} {one['mean']:.2f} ± {one['se']:.2f}" for one in files)
        self._line(f"{worker.cell.name}: {what}, {clock(worker.seconds)} ({self._rest(waiting, workers)})")

    def show(self, waiting: Sequence[Cell], workers: Sequence[_Worker]) -> None:
        now = time.monotonic()
        if not workers or now - self._said < (1.0 if self._live else _QUIET_S):
            return
        self._said = now
        at = "; ".join(f"{worker.cell.name}: {worker.told()}" for worker in workers)
        text = f"{self._rest(waiting, workers)}; {at}"
        if self._live:
            print(f"\r\x1b[K{text[: os.get_terminal_size(sys.stderr.fileno()).columns - 1]}", end="", file=sys.stderr, flush=True)
        else:
            print(text, file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Nothing is left half written on a terminal."""
        if self._live:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def _line(self, text: str) -> None:
        self.clear()
        print(text, file=sys.stderr, flush=True)

    def _rest(self, waiting: Sequence[Cell], workers: Sequence[_Worker]) -> str:
        share = f"{self._ended} of {self._total} cells"
        left = self._durations.left(waiting, [(worker.cell, worker.seconds) for worker in workers], self._jobs)
        return share if left is None or self._ended == self._total else f"{share}, about {clock(left)} left"
