"""Arrays of a source as they stand there, and the numbers that are made of them: checked here, once, for all formats."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

#: Groups in groups; deeper ones are links that lead back.
_DEPTH_MAX = 20


class InvalidData(ValueError):
    """What a source lacks, or holds that nothing can be trained on.

    Attributes:
        key: the array, as it is called in the source; empty where no single one is meant.
        row: of that array, where one row is wrong.
        why: what is wrong, and what to do where that can be said.
    """

    def __init__(self, key: str, why: str, row: int | None = None) -> None:
        self.key, self.row, self.why = key, row, why
        place = ", ".join(part for part in (f"`{key}`" if key else "", "" if row is None else f"row {row}") if part)
        super().__init__(f"{place}: {why}" if place else why)


@dataclass(frozen=True)
class Column:
    """One array of a source, or some of its rows; not read yet, where it lies in a file.

    Attributes:
        key: where it stands, for errors.
        array: a numpy array or an HDF5 data set, one row a step.
        rows: those that are meant.
        of: how many rows it must have in all.
    """

    key: str
    array: Any
    rows: range
    of: int

    def read(self) -> np.ndarray:
        """The rows that are meant, as they are. Raises `InvalidData` where there are not as many as there must be, or one is damaged."""
        if self.array.ndim == 0 or len(self.array) != self.of:
            rows = "is one value" if self.array.ndim == 0 else f"has {len(self.array)} rows"
            raise InvalidData(self.key, f"{rows}, where {self.of} are expected: one for each step, as the arrays beside it have")
        try:
            return np.asarray(self.array[self.rows.start : self.rows.stop])
        except OSError as error:
            raise InvalidData(self.key, f"cannot be read: {error}") from None

    def shape(self) -> str:
        """What a row holds, for lists: `17`, or `84 x 84 x 3 uint8`."""
        width = " x ".join(str(size) for size in self.array.shape[1:]) or "1"
        return width if self.array.dtype.kind == "f" else f"{width} {self.array.dtype}"


@dataclass(frozen=True)
class Block:
    """Steps of a source, one after the other: an episode, or a piece of a file where episodes lie side by side.

    Attributes:
        where: what the source calls the episode, `data/demo_3`; empty for a piece of a file.
        steps: how many.
        parts: what the agent may be shown, or be hidden: name -> column.
        observations: names of those of them that the source calls observations.
        actions: what was executed.
        rewards: what it earned; None where the source has none.
        terminals: (steps,) bool; the task ended in this step.
        timeouts: (steps,) bool; the clock or the recording did.
        marks: columns of the trainer's layout that the source has already, those of `MARKS`: field of `Episodes` -> column.
    """

    where: str
    steps: int
    parts: Mapping[str, Column]
    observations: tuple[str, ...]
    actions: Column
    rewards: Column | None
    terminals: np.ndarray
    timeouts: np.ndarray
    marks: Mapping[str, Column]


def vectors(column: Column) -> np.ndarray:
    """(steps, width) float32, every number finite. Raises `InvalidData` for what is no vector of floats a step."""
    shape, dtype = column.array.shape[1:], column.array.dtype
    if len(shape) > 1:
        what = "images" if _is_image(shape, dtype) else "arrays"
        raise InvalidData(column.key, f"holds {what} of {column.shape()} a step; vectors can be learned from here: choose other keys")
    if dtype.kind != "f":
        raise InvalidData(column.key, f"holds {_described(dtype)} ({dtype}), floats are expected: {_way_out(dtype)}")
    if shape == (0,):
        raise InvalidData(column.key, "has no columns")
    return _finite(column, column.read().reshape(len(column.rows), -1))


def scalars(column: Column) -> np.ndarray:
    """(steps,) float32, every number finite; whole numbers and flags are numbers here. Raises `InvalidData`."""
    return _finite(column, _single(column, "fiub"))[:, 0]


def flags(column: Column) -> np.ndarray:
    """(steps,) bool. Raises `InvalidData` for values other than 0 and 1, True and False."""
    values = _single(column, "biuf")[:, 0]
    (wrong,) = np.nonzero((values != 0) & (values != 1))
    if wrong.size:
        raise InvalidData(column.key, f"is {values[wrong[0]]:g}, and a flag is 0 or 1", column.rows[wrong[0]])
    return values.astype(bool)


def wholes(column: Column) -> np.ndarray:
    """(steps,) int64. Raises `InvalidData` for other than whole numbers."""
    return _single(column, "iu")[:, 0].astype(np.int64)


#: Fields of `Episodes` that a source may have already, as a file of `ada-collect` has, and how they are read.
MARKS: dict[str, Callable[[Column], np.ndarray]] = {"action_noise": scalars, "blind": flags, "play": flags, "session": wholes}


def leaves(group: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """(name, array) of everything in a tree of groups, dicts or tuples; names joined by `/`, `name` before them.

    Raises `InvalidData` for a name that leads nowhere, or round in circles.
    """
    if isinstance(group, tuple):
        group = {str(index): value for index, value in enumerate(group)}
    if not isinstance(group, Mapping):
        array = group if isinstance(group, h5py.Dataset) else np.asarray(group)
        if array.shape is not None:  # HDF5 knows arrays without even a shape
            yield name, array
        return
    for key in group:
        path = f"{name}/{key}" if name else str(key)
        if path.count("/") > _DEPTH_MAX:
            raise InvalidData(path, "lies too deep: its groups lead round in circles")
        try:
            value = group[key]
        except (KeyError, OSError):
            raise InvalidData(path, "is a link to something that is not there") from None
        yield from leaves(value, path)


def listed(parts: Mapping[str, Column], most: int = 40) -> str:
    """Names with what they hold, for errors: `object (14), robot0_eef_pos (3)`."""
    names = [f"{name} ({column.shape()})" for name, column in parts.items()]
    return ", ".join(names[:most] + ([f"{len(names) - most} more"] if len(names) > most else [])) or "nothing"


def _single(column: Column, kinds: str) -> np.ndarray:
    """(steps, 1) of an array of one number a step."""
    if column.array.shape[1:] not in ((), (1,)):
        raise InvalidData(column.key, f"holds {column.shape()} a step, one number is expected")
    dtype = column.array.dtype
    if dtype.kind not in kinds:
        raise InvalidData(
            column.key, f"holds {_described(dtype)} ({dtype}), {'whole numbers' if kinds == 'iu' else 'numbers'} are expected"
        )
    return column.read().reshape(-1, 1)


def _finite(column: Column, values: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        numbers = values.astype(np.float32)
    wrong = np.argwhere(~np.isfinite(numbers))
    if len(wrong):
        row, at = wrong[0]
        large = " and does not fit in 32 bits" if np.isfinite(values[row, at]) else ""
        raise InvalidData(column.key, f"is {values[row, at]:g}{large} in column {at}", column.rows[row])
    return numbers


def _is_image(shape: tuple[int, ...], dtype: np.dtype) -> bool:
    return dtype == np.uint8 or (len(shape) == 3 and (shape[0] in (1, 3, 4) or shape[-1] in (1, 3, 4)))


def _described(dtype: np.dtype) -> str:
    match dtype.kind:
        case "i" | "u":
            return "whole numbers"
        case "f":
            return "floats"
        case "b":
            return "flags"
        case "c":
            return "complex numbers"
        case "S" | "U":
            return "strings"
        case "O":
            return "strings, or lists of their own length each"
        case _:
            return "no numbers"


def _way_out(dtype: np.dtype) -> str:
    if dtype.kind in "iub":
        return "where they count something write them as floats, where they name something one-hot"
    return "choose other keys"
