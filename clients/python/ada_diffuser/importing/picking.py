"""Which parts of a source become the observation and which the hidden truth: chosen once, and then the same for all of its steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ada_diffuser.dataset import Episodes
from ada_diffuser.importing.columns import MARKS, Block, Column, InvalidData, listed, scalars, vectors
from ada_diffuser.importing.request import Request

_CONTEXT = "infos/context"


@dataclass(frozen=True)
class Part:
    """A part of a vector: its name, how many numbers it has, and the key where it was seen first."""

    name: str
    width: int
    first: str


@dataclass(frozen=True)
class Vector:
    """Parts side by side."""

    parts: tuple[Part, ...]

    @classmethod
    def of(cls, names: Sequence[str], columns: Mapping[str, Column]) -> Vector:
        """These columns. Raises `InvalidData` for one that is no vector of floats."""
        return cls(tuple(Part(name, vectors(columns[name]).shape[1], columns[name].key) for name in names))

    def joined(self, columns: Mapping[str, Column], where: str = "") -> np.ndarray:
        """(steps, width) float32. Raises `InvalidData` for a part that is missing `where` these columns are, or has another width there."""
        return np.hstack([_values(part, columns, where) for part in self.parts])

    def card(self) -> list[dict[str, Any]]:
        """Name and width of each part, and its columns, `[from, to)`."""
        ends = np.cumsum([part.width for part in self.parts]).tolist()
        return [
            {"name": part.name, "width": part.width, "columns": [end - part.width, end]} for part, end in zip(self.parts, ends, strict=True)
        ]


def _values(part: Part, columns: Mapping[str, Column], where: str) -> np.ndarray:
    if part.name not in columns:
        raise InvalidData(where, f"has no `{part.name}`, as `{part.first}` was; it has {listed(columns)}")
    values = vectors(columns[part.name])
    if values.shape[1] != part.width:
        raise InvalidData(columns[part.name].key, f"has {values.shape[1]} columns, but `{part.first}` has {part.width}")
    return values


@dataclass(frozen=True)
class Picked:
    """What is taken of each block.

    Attributes:
        observation: what the agent sees.
        action: what it did.
        context: the hidden truth; None where the source has none.
        zero_rewards: whether zeros are written for rewards.
        left_out: names of the parts that are not taken.
    """

    observation: Vector
    action: Vector
    context: Vector | None
    zero_rewards: bool
    left_out: tuple[str, ...]

    @classmethod
    def of(cls, block: Block, request: Request) -> Picked:
        """As the request says, of the first block. Raises `InvalidData` where it does not say enough, or asks for what is not there."""
        seen = _chosen("--observation", request.observation, block.parts) or _only(block)
        hidden = _chosen("--context", request.context, block.parts) or tuple(name for name in (_CONTEXT,) if name in block.parts)
        return cls(
            observation=Vector.of(seen, block.parts),
            action=Vector.of(("actions",), {"actions": block.actions}),
            context=Vector.of(hidden, block.parts) if hidden else None,
            zero_rewards=request.zero_rewards,
            left_out=tuple(name for name in block.parts if name not in (*seen, *hidden, *(f"infos/{mark}" for mark in block.marks))),
        )

    def episodes(self, block: Block) -> Episodes:
        """The block's steps in the trainer's layout. Raises `InvalidData`."""
        return Episodes(
            observations=self.observation.joined(block.parts, block.where),
            actions=self.action.joined({"actions": block.actions}),
            rewards=self._rewards(block),
            terminals=block.terminals,
            timeouts=block.timeouts,
            context=self.context.joined(block.parts, block.where) if self.context else None,
            **{mark: MARKS[mark](column) for mark, column in block.marks.items()},
        )

    def _rewards(self, block: Block) -> np.ndarray:
        if self.zero_rewards:
            return np.zeros(block.steps, np.float32)
        if block.rewards is None:
            key = f"{block.where}/rewards" if block.where else "rewards"
            raise InvalidData(key, "is missing: `--reward zero` writes 0 for every step, which is enough to imitate, but not to judge")
        return scalars(block.rewards)


def _chosen(flag: str, names: Sequence[str], parts: Mapping[str, Column]) -> tuple[str, ...]:
    """These names. Raises `InvalidData` for one that is not among the parts, or comes twice."""
    for index, name in enumerate(names):
        if name not in parts:
            raise InvalidData("", f"{flag}: there is no `{name}`; there are {listed(parts)}")
        if name in names[:index]:
            raise InvalidData("", f"{flag}: `{name}` is named twice")
    return tuple(names)


def _only(block: Block) -> tuple[str, ...]:
    """The observations, where they are one vector. Raises `InvalidData` that lists the parts where one has to choose."""
    if len(block.observations) == 1:
        return block.observations
    if not block.observations:
        raise InvalidData(
            block.where,
            f"has no observations; --observation KEY[,KEY...] takes what it has: {listed(block.parts)}. A raw robomimic file gets its "
            "observations by robomimic's dataset_states_to_obs.py",
        )
    parts = {name: block.parts[name] for name in block.observations}
    raise InvalidData(
        f"{block.where}/observations".lstrip("/"),
        f"have several parts, and the agent sees one vector: choose, in their order, with --observation KEY[,KEY...] of {listed(parts)}",
    )
