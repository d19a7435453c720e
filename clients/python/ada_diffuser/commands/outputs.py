"""The files that a command writes: checked before anything is run, so that no result is lost for want of a folder."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any


def check_output(flag: str, path: Path | None, *suffixes: str) -> None:
    """Makes the folder of an output and tries to write there. Raises `ValueError` naming the flag; nothing to do without a path."""
    if path is None:
        return
    if suffixes and path.suffix.lower() not in suffixes:
        raise ValueError(f"{flag} must end in {' or '.join(suffixes)}, not {path.name!r}")
    if path.is_dir():
        raise ValueError(f"{flag} {path} is a directory, and a file is to be written")
    if _is_device(path):
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ValueError(f"{flag} {path}: cannot write there: {error.strerror or error}") from error


def save_json(value: Any, path: Path) -> None:
    """As `save_text` does."""
    save_text(json.dumps(value, indent=1) + "\n", path)


def save_text(text: str, path: Path) -> None:
    """Write beside and rename, so that a reader, or a crash, never meets half a file."""
    if _is_device(path):
        path.write_text(text, encoding="utf-8")
        return
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def _is_device(path: Path) -> bool:
    """/dev/stdout, a pipe: there is no folder to write in, and nothing may be put in its place."""
    return path.exists() and not path.is_file()
