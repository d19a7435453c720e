"""Data sets of other formats, taken as they are: what `ada-import` does, for Python.

One way: a source is recognised and opened (`recognise`); it yields its steps as blocks of columns (`d4rl`, `minari_set`, `robomimic`), of
which the wanted parts are picked (`picking`), checked and joined (`columns`), and written in the one layout that the trainer reads.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from ada_diffuser.dataset import episode_returns, returns_summary, save_card, sha256, writing_episodes
from ada_diffuser.importing.columns import InvalidData
from ada_diffuser.importing.picking import Picked
from ada_diffuser.importing.recognise import Source, opened
from ada_diffuser.importing.request import Request

__all__ = ["InvalidData", "Request", "import_data"]

#: Shows how far an import is: called with the number of all steps, yields what is called with the number of those just written.
Progress = Callable[[int], AbstractContextManager[Callable[[int], object]]]


def _unseen(steps: int) -> AbstractContextManager[Callable[[int], object]]:
    return nullcontext(lambda made: None)


def import_data(request: Request, out: Path, command: str = "", progress: Progress = _unseen) -> dict[str, Any]:
    """Write the source's episodes to `out`, and the data card beside it, which is returned; `command` is what the card says made it.

    Nothing is written, and what was there stays, where this raises: `InvalidData` for what the source lacks or holds, with its key and
    row; `ValueError` for a request that does not fit it; `OSError` where a file cannot be read or written.
    """
    with opened(request) as source:
        if out.exists() and any(out.samefile(file) for file in source.files):
            raise ValueError(f"--out {out} is the source itself")
        digest = _digest(source.folder, source.files)
        picked: Picked | None = None
        ends, rewards = [], []
        with writing_episodes(out, source.steps) as append, progress(source.steps) as advance:
            for block in source.blocks():
                picked = picked or Picked.of(block, request)
                episodes = picked.episodes(block)
                append(episodes)
                ends.append(episodes.terminals | episodes.timeouts)
                rewards.append(episodes.rewards)
                advance(block.steps)
        assert picked is not None, "a source has steps"
        card = _card(source, request, picked, np.concatenate(ends), np.concatenate(rewards))
    card["imported"] |= digest
    card["file"] = {"name": out.name, "sha256": sha256(out), "bytes": out.stat().st_size}
    card["command"] = command
    save_card(card, out)
    return card


def _card(source: Source, request: Request, picked: Picked, ends: np.ndarray, rewards: np.ndarray) -> dict[str, Any]:
    """What the episodes are and where they came from, without the facts about files."""
    lengths = np.diff(np.flatnonzero(ends), prepend=-1)
    notes = [*source.notes, *(["rewards are zeros: --reward zero"] if request.zero_rewards else [])]
    return {
        "format": "d4rl-hdf5",
        "imported": {"format": source.format, "name": source.name, **({"filter": request.filter} if request.filter else {})},
        **({"environment": source.environment} if source.environment else {}),
        "episodes": len(lengths),
        "steps": len(rewards),
        "lengths": {"median": float(np.median(lengths)), "min": int(lengths.min()), "max": int(lengths.max())},
        "returns": returns_summary(episode_returns(rewards, ends)),
        "observations": picked.observation.card(),
        "actions": picked.action.card(),
        **({"context": picked.context.card()} if picked.context else {}),
        "left_out": list(picked.left_out),
        "notes": notes,
        "versions": {name: version(name) for name in ("ada-diffuser", "h5py", "numpy", *source.libraries)},
    }


def _digest(folder: Path, files: list[Path]) -> dict[str, Any]:
    """SHA-256 and size of a file; of several, the SHA-256 of what `sha256sum` prints of them, sorted, with their names in the folder."""
    size = sum(file.stat().st_size for file in files)
    if len(files) == 1:
        return {"sha256": sha256(files[0]), "bytes": size}
    lines = "".join(f"{sha256(file)}  {file.relative_to(folder).as_posix()}\n" for file in files)
    return {"sha256": hashlib.sha256(lines.encode()).hexdigest(), "bytes": size}
