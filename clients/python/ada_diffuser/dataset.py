"""Episodes on disk in D4RL's layout, and the data card beside them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np


@dataclass
class Episodes:
    """Flat arrays, one row a step: the observation before it, the action executed in it, the reward it earned.

    Attributes:
        observations: (N, observation), float32.
        actions: (N, action), float32, as executed (clipped, noise included).
        rewards: (N,), float32.
        terminals: (N,), bool; the task ended in this step.
        timeouts: (N,), bool; the clock ended the episode in this step.
        action_noise: (N,), float32; standard deviation of the episode's action noise.
        context: (N, context), float32; what was hidden while the action was executed; None where the environment tells none.
        blind: (N,), bool; whether the episode was flown without sight of the context; None where none was meant to be.
        play: (N,), bool; whether it shows what comes of actions and is nothing to imitate; None where all is to be imitated.
        goal: (N, columns), float32; what was wanted in the step, in the environment's `goal_columns`; None where it has no goals.
        session: (N,), int64; episodes with the same number follow one another, and what is hidden may outlast them; None where none was
            meant to.
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminals: np.ndarray
    timeouts: np.ndarray
    action_noise: np.ndarray
    context: np.ndarray | None = None
    blind: np.ndarray | None = None
    play: np.ndarray | None = None
    session: np.ndarray | None = None
    goal: np.ndarray | None = None

    def returns(self) -> np.ndarray:
        """Undiscounted return of each episode, shape (episodes,), float64."""
        ends = np.flatnonzero(self.terminals | self.timeouts)
        starts = np.concatenate([[0], ends[:-1] + 1])
        return np.add.reduceat(self.rewards.astype(np.float64), starts)

    def columns(self) -> dict[str, np.ndarray]:
        """D4RL path -> array, for what there is."""
        found = {path: getattr(self, name) for name, path in _PATHS.items()}
        return {path: column for path, column in found.items() if column is not None}


_PATHS = {
    "observations": "observations",
    "actions": "actions",
    "rewards": "rewards",
    "terminals": "terminals",
    "timeouts": "timeouts",
    "context": "infos/context",
    "action_noise": "infos/action_noise",
    "blind": "infos/blind",
    "play": "infos/play",
    "session": "infos/session",
    "goal": "infos/goal",
}
"""Field of `Episodes` -> path in the file, in the order of writing."""
_OPTIONAL = ("context", "blind", "play", "session", "goal")


def save_episodes(episodes: Episodes, path: Path) -> str:
    """Write beside and rename; returns the SHA-256 of the file. The same episodes give the same bytes."""
    partial = path.with_name(f".{path.name}.partial")
    with h5py.File(partial, "w", libver="earliest") as file:
        for name, column in episodes.columns().items():
            file.create_dataset(name, data=column, track_times=False)
    digest = sha256(partial)
    os.replace(partial, path)
    return digest


def load_episodes(path: Path) -> Episodes:
    """Read what `save_episodes` wrote. Raises `KeyError` naming a missing column."""
    with h5py.File(path, "r") as file:
        present = {name: path for name, path in _PATHS.items() if name not in _OPTIONAL or path in file}
        return Episodes(**{name: file[path][()] for name, path in present.items()})


def with_play(own: Episodes, others: Sequence[Episodes]) -> Episodes:
    """The episodes of several data sets, of which those of the others are play: a latent learns from them, no planner imitates them.

    Raises `ValueError` if they do not have the same columns. Sessions are numbered on.
    """
    parts = [own, *(replace(other, play=np.ones(len(other.rewards), bool)) for other in others)]
    columns: dict[str, np.ndarray | None] = {}
    for name in _PATHS:
        found = [getattr(part, name) for part in parts]
        if name in ("play", "blind"):
            found = [np.zeros(len(part.rewards), bool) if column is None else column for part, column in zip(parts, found, strict=True)]
        told = [column for column in found if column is not None]
        if told and (len(told) < len(found) or len({column.shape[1:] for column in told}) > 1):
            shapes = " and ".join("none" if column is None else str(column.shape[1:]) for column in found)
            raise ValueError(f"data sets with {_PATHS[name]} of {shapes} columns do not go together")
        if name == "session" and told:
            counts = np.cumsum([0, *(column.max() + 1 for column in told[:-1])])
            told = [column + first for column, first in zip(told, counts, strict=True)]
        columns[name] = np.concatenate(told) if told else None
    if not columns["blind"].any():  # type: ignore[union-attr]
        columns["blind"] = own.blind
    return Episodes(**columns)  # type: ignore[arg-type]


def card_path(path: Path) -> Path:
    """`X.h5` -> `X.card.json`."""
    return path.with_name(f"{path.stem}.card.json")


def save_card(card: dict[str, Any], path: Path) -> None:
    """Write the data card of the data set at `path`, beside it."""
    target = card_path(path)
    partial = target.with_name(f".{target.name}.partial")
    partial.write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")
    os.replace(partial, target)


def sha256(path: Path) -> str:
    """Digest of a file, hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
