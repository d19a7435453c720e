"""How far a command is: a bar on a terminal, a line now and then in a log."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

LINE_EVERY_S = 10.0


@contextmanager
def progress(total: int, title: str, unit: str, *, quiet: bool = False) -> Iterator[Callable[[int], object]]:
    """Yields what is to be called with the number of steps just made, `total` of them at most; shown on stderr."""
    if quiet:
        yield lambda made: None
    elif sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(total=total, desc=title, unit=unit, leave=False, dynamic_ncols=True) as bar:
            yield bar.update
    else:
        yield _Lines(total, title, unit).add


@contextmanager
def saying(program: str) -> Iterator[None]:
    """What the client has to say meanwhile stands on stderr, a line each, and behind the program's name."""
    log, words = logging.getLogger("ada_diffuser"), _Words(program)
    log.addHandler(words)
    try:
        yield
    finally:
        log.removeHandler(words)


class _Words(logging.Handler):
    def __init__(self, program: str) -> None:
        super().__init__()
        self._program = program

    def emit(self, record: logging.LogRecord) -> None:
        line = f"{self._program}: {record.getMessage()}"
        if sys.stderr.isatty():
            from tqdm import tqdm

            tqdm.write(line, file=sys.stderr)  # a bar that stands there gives way to it
        else:
            print(line, file=sys.stderr, flush=True)


@dataclass
class _Lines:
    """One line each ten seconds, so that a log stays readable; a task that takes less leaves none, nor does one that is over."""

    total: int
    title: str
    unit: str
    made: int = 0
    started: float = field(default_factory=lambda: time.monotonic())
    told: float = field(default_factory=lambda: time.monotonic())

    def add(self, made: int) -> None:
        self.made += made
        now = time.monotonic()
        if now - self.told < LINE_EVERY_S or not 0 < self.made < self.total:
            return
        self.told = now
        rate = self.made / (now - self.started)
        share = f"{self.made} of {self.total} {self.unit}s ({100 * self.made // self.total} %)"
        left = clock((self.total - self.made) / rate)
        print(f"{self.title}: {share}, {rate:.3g} a second, {left} left", file=sys.stderr, flush=True)


def clock(seconds: float) -> str:
    """1:02:03, or 2:03 below an hour."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
