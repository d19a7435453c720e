"""A server of one's own over variants of a checkpoint that differ in `[restart]`, which no session can choose."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ada_diffuser.client import Client
from ada_diffuser.commands.programs import Programs, serving


@contextmanager
def served(programs: Programs, checkpoint: Path, variants: Sequence[Sequence[str]]) -> Iterator[Client]:
    """A client of a server on loopback whose models `0`, `1`, ... are the checkpoint with these keys; both are gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="ada-choose-") as folder:
        models = Path(folder, "models")
        models.mkdir()
        for n, keys in enumerate(variants):
            programs.defaults(checkpoint, models / str(n), keys)
        with serving(programs, models, "0", Path(folder, "log")) as client:
            yield client
