"""Steps that were recorded before, for the sessions of a trial to begin with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ada_diffuser.dataset import PATHS
from ada_diffuser.messages import Executed

#: Of a longer episode the last steps are taken: more would hardly fit into a message, nor change much of what is believed.
STEPS_MAX = 1000


@dataclass(frozen=True, eq=False)
class WarmStart:
    """The last steps of an episode of a data set."""

    #: As it was asked for.
    path: Path
    #: Its number in the data set, from 0.
    episode: int
    #: Oldest first, at most `STEPS_MAX`; each with its state, action and reward.
    steps: tuple[Executed, ...]

    @classmethod
    def parse(cls, word: str) -> WarmStart:
        """`FILE` or `FILE:EPISODE`; negative episodes count from the end, and without one it is the last.

        Raises `ValueError` for an episode that the file has not, and `OSError` or `KeyError` for a file that is no data set.
        """
        name, colon, number = word.rpartition(":")
        if not colon or Path(word).exists():
            return cls.load(Path(word))
        try:
            return cls.load(Path(name), int(number))
        except ValueError as error:
            if number.removeprefix("-").isdigit():
                raise
            raise ValueError(f"{word!r} is not FILE:EPISODE, as {number!r} is no whole number") from error

    @classmethod
    def load(cls, path: Path, episode: int = -1) -> WarmStart:
        """See `parse`."""
        with h5py.File(path, "r") as file:
            ends = np.flatnonzero(file[PATHS["terminals"]][()].astype(bool) | file[PATHS["timeouts"]][()].astype(bool)) + 1
            if not -len(ends) <= episode < len(ends):
                raise ValueError(f"{path} has {len(ends)} episodes, and none with the number {episode}")
            number = episode % len(ends)
            first, end = (ends[number - 1] if number else 0), ends[number]
            rows = slice(max(first, end - STEPS_MAX), end)
            columns = [file[PATHS[name]][rows] for name in ("observations", "actions", "rewards")]
        return cls(path, number, tuple(Executed(*step) for step in zip(*columns, strict=True)))

    def as_json(self) -> dict[str, Any]:
        """What of it stands in a result."""
        return {"file": str(self.path), "episode": self.episode, "steps": len(self.steps)}
