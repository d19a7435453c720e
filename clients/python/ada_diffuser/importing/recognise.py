"""Which format a source has, and how it is opened."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import h5py

from ada_diffuser.importing.columns import Block, InvalidData
from ada_diffuser.importing.d4rl import D4rlSource
from ada_diffuser.importing.request import Request
from ada_diffuser.importing.robomimic import RobomimicSource

_FILES = {"d4rl": D4rlSource, "robomimic": RobomimicSource}
#: As minari has them: (namespace/)name-v0.
_MINARI_ID = re.compile(r"(?:[-\w]+/)*[-\w]+-v\d+")


class Source(Protocol):
    """An open data set of one of the formats.

    Attributes:
        format: which.
        name: of the file, or the id of the data set.
        folder: where its files lie.
        files: what it is made of.
        environment: id and options, where the source tells them.
        libraries: those that read it, besides h5py.
        steps: of all blocks together.
        notes: what a person should know; complete when all blocks were read.
    """

    format: str
    name: str
    folder: Path
    files: list[Path]
    environment: dict[str, Any] | None
    libraries: tuple[str, ...]
    steps: int

    @property
    def notes(self) -> list[str]: ...

    def blocks(self) -> Iterator[Block]:
        """All steps, in the source's order. Raises `InvalidData` at what is not as it has to be."""
        ...


@contextmanager
def opened(request: Request) -> Iterator[Source]:
    """The source, while it is open. Raises `InvalidData` where it is none, `ValueError` where the request does not fit it."""
    kind = request.format or recognised(request.source)
    if request.filter is not None and kind != "robomimic":
        raise ValueError(f"--filter names a mask of a robomimic file, and {request.source} is of {kind}")
    if request.episode_steps is not None and kind != "d4rl":
        raise ValueError(f"--episode-steps is for D4RL files without timeouts; the episodes of {kind} end where they were recorded to")
    if kind == "minari":
        from ada_diffuser.importing.minari_set import MinariSource  # minari is needed for this alone

        yield MinariSource(request)
        return
    if kind not in _FILES:
        raise ValueError(f"format {kind!r} is none of d4rl, minari, robomimic")
    with _file(request.source) as file:
        yield _FILES[kind](Path(request.source), file, request)


def recognised(source: str) -> str:
    """`d4rl`, `minari` or `robomimic`. Raises `InvalidData` that says what was looked for where it is none of them."""
    path = Path(source)
    if path.is_dir():
        if any((path / name).exists() for name in ("metadata.json", "data/metadata.json")):
            return "minari"
        raise InvalidData("", f"{source} is a folder without data/metadata.json, so no Minari data set; other formats are single files")
    if not path.exists() and _MINARI_ID.fullmatch(source):
        return "minari"
    with _file(source) as file:
        roots = list(file)
        data = list(file["data"]) if isinstance(file.get("data"), h5py.Group) else []
    if "observations" in roots or "actions" in roots:
        return "d4rl"
    if any(name.startswith("demo") for name in data):
        return "robomimic"
    if any(name.startswith("episode_") for name in roots):
        if path.with_name("metadata.json").exists():
            return "minari"
        raise InvalidData("", f"{source} is the file of a Minari data set, but metadata.json is not beside it: bring the whole folder")
    raise InvalidData(
        "",
        f"{source} is of no format that is known: no `observations` at its root (D4RL), no `data/demo_0` (robomimic), no `episode_0` "
        f"(Minari); at its root are {', '.join(roots[:20]) or 'nothing'}",
    )


def _file(source: str) -> h5py.File:
    path = Path(source)
    if not path.exists():
        raise InvalidData("", f"{source} is not there, and no id of a Minari data set, as D4RL/pointmaze/umaze-v2")
    if path.is_dir():
        raise InvalidData("", f"{source} is a folder, and one HDF5 file is expected")
    if not h5py.is_hdf5(path):
        raise InvalidData("", f"{source} is no HDF5 file")
    try:
        return h5py.File(path, "r")
    except OSError as error:
        raise InvalidData("", f"{source} cannot be opened, or is only a part of a file: {error}") from None
