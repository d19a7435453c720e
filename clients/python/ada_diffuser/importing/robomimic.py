"""robomimic's layout, which LIBERO has too: a group for each demonstration, in it a group of observations by key."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ada_diffuser.importing.columns import Block, Column, InvalidData, flags, leaves
from ada_diffuser.importing.request import Request
from ada_diffuser.importing.whole import EpisodeEnds

#: Arrays of a demonstration that no agent is shown.
_OTHERS = ("actions", "rewards", "dones", "next_obs")


class RobomimicSource:
    """A file with `data/demo_0/actions`, `data/demo_0/obs/KEY` and so on; `mask/KEY` names demonstrations."""

    format, libraries = "robomimic", ()

    def __init__(self, path: Path, file: h5py.File, request: Request) -> None:
        self.name, self.folder, self.files = path.name, path.parent, [path]
        self._data = file.get("data")
        if not isinstance(self._data, h5py.Group):
            raise InvalidData("data", f"is missing; the file has {', '.join(file) or 'nothing'}")
        self.environment = _environment(self._data.attrs.get("env_args"))
        self._demos = self._chosen(file, request.filter)
        self.steps = sum(self._steps(demo) for demo in self._demos)
        self._ends = EpisodeEnds("demonstration", "dones")

    @property
    def notes(self) -> list[str]:
        return self._ends.notes()

    def blocks(self) -> Iterator[Block]:
        """The demonstrations, by number."""
        for demo in self._demos:
            yield self._block(demo)

    def _block(self, demo: str) -> Block:
        group, steps = self._data[demo], self._steps(demo)
        columns = {name: Column(f"data/{demo}/{name}", array, range(steps), steps) for name, array in leaves(group)}
        seen = {name.removeprefix("obs/"): column for name, column in columns.items() if name.startswith("obs/")}
        rest = {name: column for name, column in columns.items() if name.split("/")[0] not in (*_OTHERS, "obs")}
        dones = flags(columns["dones"]) if "dones" in columns else np.zeros(steps, np.bool_)
        terminals, timeouts = self._ends.of(dones, np.zeros(steps, np.bool_))
        return Block(
            where=f"data/{demo}",
            steps=steps,
            parts=rest | seen,
            observations=tuple(seen),
            actions=columns["actions"],
            rewards=columns.get("rewards"),
            terminals=terminals,
            timeouts=timeouts,
            marks={},
        )

    def _chosen(self, file: h5py.File, filter_key: str | None) -> list[str]:
        """Names of the demonstrations, all or those of a mask, by number."""
        there = [name for name, value in self._data.items() if isinstance(value, h5py.Group)]
        if filter_key is not None:
            there = self._masked(file, filter_key, there)
        if not there:
            raise InvalidData("data", "has no demonstrations")
        return sorted(there, key=_number)

    def _masked(self, file: h5py.File, filter_key: str, there: list[str]) -> list[str]:
        masks = file.get("mask")
        names = list(masks) if isinstance(masks, h5py.Group) else []
        if filter_key not in names:
            raise InvalidData("", f"--filter {filter_key}: there is no such mask; the file has {', '.join(names) or 'none'}")
        key = f"mask/{filter_key}"
        demos = [name.decode() if isinstance(name, bytes) else str(name) for name in np.asarray(file[key]).ravel()]
        for row, demo in enumerate(demos):
            if demo not in there:
                raise InvalidData(key, f"names {demo}, which is not in `data`", row)
        if not demos:
            raise InvalidData(key, "names no demonstrations")
        return list(dict.fromkeys(demos))

    def _steps(self, demo: str) -> int:
        group = self._data[demo]
        actions = group.get("actions")
        if not isinstance(actions, h5py.Dataset) or actions.ndim == 0:
            raise InvalidData(f"data/{demo}/actions", f"is missing; the demonstration has {', '.join(group) or 'nothing'}")
        told = group.attrs.get("num_samples", len(actions))
        if len(actions) != told:
            raise InvalidData(f"data/{demo}/actions", f"has {len(actions)} rows, but the attribute `num_samples` says {told}")
        if len(actions) == 0:
            raise InvalidData(f"data/{demo}/actions", "has no rows")
        return len(actions)


def _number(demo: str) -> tuple[int, str]:
    number = re.search(r"\d+$", demo)
    return (int(number.group()) if number else -1, demo)


def _environment(env_args: Any) -> dict[str, Any] | None:
    """What the attribute `env_args` of `data` says, as a card does; None where it says nothing that can be read."""
    try:
        told = json.loads(env_args)
        return {"id": told["env_name"], "options": told.get("env_kwargs", {})}
    except (TypeError, ValueError, KeyError):
        return None
