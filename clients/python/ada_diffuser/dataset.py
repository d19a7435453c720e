"""Episodes on disk in D4RL's layout, and the data card beside them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
        action_noise: (N,), float32; standard deviation of the episode's action noise; None where nobody knows it.
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
    action_noise: np.ndarray | None = None
    context: np.ndarray | None = None
    blind: np.ndarray | None = None
    play: np.ndarray | None = None
    session: np.ndarray | None = None
    goal: np.ndarray | None = None

    def returns(self) -> np.ndarray:
        """Undiscounted return of each episode, shape (episodes,), float64."""
        return episode_returns(self.rewards, self.terminals | self.timeouts)

    def columns(self) -> dict[str, np.ndarray]:
        """D4RL path -> array, for what there is."""
        found = {path: getattr(self, name) for name, path in PATHS.items()}
        return {path: column for path, column in found.items() if column is not None}


PATHS = {
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
_OPTIONAL = ("context", "action_noise", "blind", "play", "session", "goal")


def episode_returns(rewards: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Undiscounted return of each episode, (episodes,) float64, of rewards (N,) and last steps (N,) bool, the last row among them."""
    last = np.flatnonzero(ends)
    return np.add.reduceat(rewards.astype(np.float64), np.concatenate([[0], last[:-1] + 1]))


def save_episodes(episodes: Episodes, path: Path) -> str:
    """Write beside and rename; returns the SHA-256 of the file. The same episodes give the same bytes."""
    with writing_episodes(path, len(episodes.rewards)) as append:
        append(episodes)
    return sha256(path)


@contextmanager
def writing_episodes(path: Path, steps: int) -> Iterator[Callable[[Episodes], None]]:
    """Yields what appends steps to a file of `steps` rows, which is there when all are written, and else not at all.

    No more than one piece is in memory. The same steps give the same bytes, in however many pieces; all pieces have the same columns.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        with h5py.File(partial, "w", libver="earliest") as file:
            writer = _Writer(file, steps)
            yield writer.append
            if writer.written != steps:
                raise ValueError(f"{writer.written} of {steps} steps were written")
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


@dataclass
class _Writer:
    file: h5py.File
    steps: int
    written: int = 0

    def append(self, episodes: Episodes) -> None:
        rows = slice(self.written, self.written + len(episodes.rewards))
        for name, column in episodes.columns().items():
            if self.written == 0:
                self.file.create_dataset(name, (self.steps, *column.shape[1:]), column.dtype, track_times=False)
            self.file[name][rows] = column
        self.written = rows.stop


def load_episodes(path: Path) -> Episodes:
    """Read what `save_episodes` wrote. Raises `KeyError` naming a missing column."""
    with h5py.File(path, "r") as file:
        present = {name: path for name, path in PATHS.items() if name not in _OPTIONAL or path in file}
        return Episodes(**{name: file[path][()] for name, path in present.items()})


def with_play(own: Episodes, others: Sequence[Episodes]) -> Episodes:
    """The episodes of several data sets, of which those of the others are play: a latent learns from them, no planner imitates them.

    Raises `ValueError` if they do not have the same columns. Sessions are numbered on.
    """
    parts = [own, *(replace(other, play=np.ones(len(other.rewards), bool)) for other in others)]
    columns: dict[str, np.ndarray | None] = {}
    for name in PATHS:
        found = [getattr(part, name) for part in parts]
        if name in ("play", "blind"):
            found = [np.zeros(len(part.rewards), bool) if column is None else column for part, column in zip(parts, found, strict=True)]
        told = [column for column in found if column is not None]
        if name == "action_noise" and len(told) < len(found):
            told = []  # what is known of some rows alone is left out: nobody trains on it
        if told and (len(told) < len(found) or len({column.shape[1:] for column in told}) > 1):
            shapes = " and ".join("none" if column is None else str(column.shape[1:]) for column in found)
            raise ValueError(f"data sets with {PATHS[name]} of {shapes} columns do not go together")
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


def returns_summary(returns: np.ndarray, failed: np.ndarray | None = None) -> dict[str, Any]:
    """What a card says of the returns (episodes,) of at least one episode, and of which failed, where that is known."""
    return {
        "mean": round(float(returns.mean()), 3),
        "standard_error": round(float(returns.std(ddof=1) / np.sqrt(len(returns))), 3) if len(returns) > 1 else None,
        "median": round(float(np.median(returns)), 3),
        "min": round(float(returns.min()), 3),
        "max": round(float(returns.max()), 3),
    } | ({} if failed is None else {"failures": int(failed.sum())})


def sha256(path: Path) -> str:
    """Digest of a file, hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
