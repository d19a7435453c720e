"""D4RL's layout: flat arrays at the root, episodes one after the other. What is read here is what is written, but for the checks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from ada_diffuser.dataset import PATHS
from ada_diffuser.importing.columns import MARKS, Block, Column, InvalidData, flags, leaves
from ada_diffuser.importing.request import Request

#: Rows that are in memory at a time.
PIECE_ROWS = 1 << 15
#: D4RL's names and Gymnasium's; a flag in any of them ends an episode.
_TERMINALS, _TIMEOUTS = ("terminals", "terminations"), ("timeouts", "truncations")
_NEXT = "next_observations"
#: What no agent is shown.
_OTHERS = ("actions", "rewards", _NEXT, "metadata", *_TERMINALS, *_TIMEOUTS)
#: Where the next observation is this near to the next row in every column, relative and absolute, the rows follow one another.
_NEAR = 1e-3


class D4rlSource:
    """A file with these arrays; see `docs/data.md`."""

    format, libraries = "d4rl", ()

    def __init__(self, path: Path, file: h5py.File, request: Request) -> None:
        self.name, self.folder, self.files, self.environment = path.name, path.parent, [path], None
        self.notes: list[str] = []
        self._arrays = dict(leaves(file))
        self.steps = self._count_rows()
        self._terminals, self._timeouts = self._ends(request.episode_steps)
        self._jumps: list[int] = []

    def blocks(self) -> Iterator[Block]:
        """Pieces of the file, however long episodes are."""
        for start in range(0, self.steps, PIECE_ROWS):
            rows = range(start, min(start + PIECE_ROWS, self.steps))
            self._look_for_jumps(rows)
            yield self._block(rows)
        self._note_jumps()

    def _block(self, rows: range) -> Block:
        columns = {name: Column(name, array, rows, self.steps) for name, array in self._arrays.items()}
        marks = {field: columns[PATHS[field]] for field in MARKS if PATHS[field] in columns}
        return Block(
            where="",
            steps=len(rows),
            parts={name: column for name, column in columns.items() if name.split("/")[0] not in _OTHERS},
            observations=tuple(name for name in columns if name.split("/")[0] == "observations"),
            actions=columns["actions"],
            rewards=columns.get("rewards"),
            terminals=self._terminals[rows.start : rows.stop],
            timeouts=self._timeouts[rows.start : rows.stop],
            marks=marks,
        )

    def _count_rows(self) -> int:
        """The rows of `actions`, which all other arrays must have."""
        if not any(path.split("/")[0] == "observations" for path in self._arrays):
            raise self._missing("observations")
        if "actions" not in self._arrays:
            raise self._missing("actions")
        array = self._arrays["actions"]
        if array.ndim == 0 or len(array) == 0:
            raise InvalidData("actions", "has no rows")
        return len(array)

    def _missing(self, name: str) -> InvalidData:
        roots = dict.fromkeys(path.split("/")[0] for path in self._arrays)
        groups = [path for path in self._arrays if path.endswith(f"/{name}")]
        hint = f"; `{groups[0]}` is there, but arrays are expected at the root" if groups else ""
        return InvalidData(name, f"is missing; the file has {', '.join(roots) or 'nothing'}{hint}")

    def _ends(self, episode_steps: int | None) -> tuple[np.ndarray, np.ndarray]:
        """The flags of all rows; the last row is the last step of an episode in any case."""
        terminals, timeouts = self._flags(_TERMINALS), self._flags(_TIMEOUTS)
        if terminals is None:
            raise self._missing("terminals")
        if timeouts is not None and episode_steps is not None:
            raise ValueError("--episode-steps cuts where nothing else says where the clock ended an episode; this file has `timeouts`")
        if timeouts is None and episode_steps is None:
            raise InvalidData(
                "timeouts",
                "is missing, as in D4RL's oldest files, so nothing says where the clock ended an episode: --episode-steps N ends one after "
                "so many steps (1000 in D4RL's locomotion; more than the longest has, where `terminals` alone ends them)",
            )
        if timeouts is None:
            timeouts = _cut(terminals, episode_steps)
            self.notes.append(f"no timeouts in the source: episodes end by `terminals`, or after {episode_steps} steps")
        if not terminals[-1] and not timeouts[-1]:
            timeouts[-1] = True
            self.notes.append("the recording stops within the last episode, whose last step counts as a timeout")
        if held := int((terminals[1:] & (terminals | timeouts)[:-1]).sum()):
            self.notes.append(f"`terminals` is true in {held} step(s) right after an episode's end: each is an episode of one step")
        return terminals, timeouts

    def _flags(self, names: tuple[str, ...]) -> np.ndarray | None:
        found = [flags(Column(name, self._arrays[name], range(self.steps), self.steps)) for name in names if name in self._arrays]
        return np.logical_or.reduce(found) if found else None

    def _look_for_jumps(self, rows: range) -> None:
        """Rows of which the next is not what their step led to, though no flag ends an episode there."""
        here, following = self._arrays.get("observations"), self._arrays.get(_NEXT)
        if here is None or following is None or here.shape != following.shape or here.ndim > 2 or here.dtype.kind != "f":
            return
        later = range(rows.start + 1, min(rows.stop + 1, self.steps))
        led_to = Column(_NEXT, following, rows, self.steps).read().reshape(len(rows), -1)
        came = Column("observations", here, later, self.steps).read().reshape(len(later), led_to.shape[1])
        ends = (self._terminals | self._timeouts)[rows.start : rows.stop][: len(came)]
        same = np.isclose(led_to[: len(came)], came, rtol=_NEAR, atol=_NEAR).all(axis=1)
        self._jumps.extend((rows.start + np.flatnonzero(~same & ~ends)).tolist())

    def _note_jumps(self) -> None:
        if not self._jumps:
            return
        inner = self.steps - int((self._terminals | self._timeouts).sum())
        if len(self._jumps) > inner / 2:
            why = (
                f"is not the row after its own at {len(self._jumps)} of the {inner} rows that end no episode: these are single steps in no "
                f"order, and whole episodes are needed (where they are whole all the same, import a copy without `{_NEXT}`)"
            )
            raise InvalidData(_NEXT, why, self._jumps[0])
        self.notes.append(
            f"`{_NEXT}` is not the row after its own at {len(self._jumps)} rows that end no episode, the first of them row "
            f"{self._jumps[0]}: episodes may be glued together there"
        )


def _cut(terminals: np.ndarray, steps: int) -> np.ndarray:
    """(N,) bool: every so many steps, counted from each episode's first."""
    timeouts = np.zeros(len(terminals), np.bool_)
    first = 0
    for last in [*np.flatnonzero(terminals), len(terminals) - 1]:
        timeouts[first + steps - 1 : last + 1 : steps] = True
        first = int(last) + 1
    return timeouts & ~terminals
