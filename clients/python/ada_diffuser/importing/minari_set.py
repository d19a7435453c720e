"""Minari's data sets, read by the library `minari`, whatever they are stored as."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import minari
import numpy as np

from ada_diffuser.importing.columns import Block, Column, InvalidData, flags, leaves
from ada_diffuser.importing.request import Request
from ada_diffuser.importing.whole import EpisodeEnds


class MinariSource:
    """The episodes of a data set: a folder, its file, or an id in the folder of the user's data sets."""

    format, libraries = "minari", ("minari",)

    def __init__(self, request: Request) -> None:
        self._set = _opened(request.source)
        self.name = self._set.spec.dataset_id
        self.folder = Path(self._set.spec.data_path)
        self.files = sorted(path for path in self.folder.rglob("*") if path.is_file())
        spec = self._set.env_spec
        self.environment = None if spec is None else {"id": spec.id, "options": spec.kwargs}
        self.steps = self._set.total_steps
        if not self.steps:
            raise InvalidData("", f"the Minari data set {self.name} has no steps")
        self._ends = EpisodeEnds("episode", "terminations` or `truncations")

    @property
    def notes(self) -> list[str]:
        return self._ends.notes()

    def blocks(self) -> Iterator[Block]:
        """The episodes, in Minari's order."""
        episodes, steps = iter(self._set.iterate_episodes()), 0
        for index in self._set.episode_indices:
            block = self._block(_next(episodes, index))
            steps += block.steps
            if steps <= self.steps:
                yield block
        if steps != self.steps:
            raise InvalidData("metadata.json", f"says `total_steps` {self.steps}, but the episodes have {steps} together")

    def _block(self, episode: Any) -> Block:
        name, steps = f"episode_{episode.id}", len(episode.rewards)
        if steps == 0:
            raise InvalidData(f"{name}/rewards", "has no rows")

        def column(key: str, array: Any) -> Column:
            return Column(f"{name}/{key}", np.asarray(array), range(steps), steps)

        seen = {_short(key): _before(name, key, array, steps) for key, array in leaves(episode.observations, "observations")}
        told = {key: _info(name, key, array, steps) for key, array in leaves(episode.infos or {}, "infos")}
        actions = dict(leaves(episode.actions, "actions"))
        if list(actions) != ["actions"]:
            raise InvalidData(f"{name}/actions", f"has the parts {', '.join(map(_short, actions))}: actions are one vector here")
        terminals, timeouts = (flags(column(key, getattr(episode, key))) for key in ("terminations", "truncations"))
        terminals, timeouts = self._ends.of(terminals, timeouts)
        return Block(
            where=name,
            steps=steps,
            parts=seen | told,
            observations=tuple(seen),
            actions=column("actions", actions["actions"]),
            rewards=column("rewards", episode.rewards),
            terminals=terminals,
            timeouts=timeouts,
            marks={},
        )


def _before(name: str, key: str, array: np.ndarray, steps: int) -> Column:
    """The observation before each step; the last one there is follows the last step."""
    return Column(f"{name}/{key}", array, range(steps), steps + 1)


def _info(name: str, key: str, array: np.ndarray, steps: int) -> Column:
    """What the environment told of each step when it was made; before them stands what it told at its reset."""
    if array.ndim and len(array) == steps + 1:
        return Column(f"{name}/{key}", array, range(1, steps + 1), steps + 1)
    return Column(f"{name}/{key}", array, range(steps), steps)


def _short(key: str) -> str:
    """Parts of a dict go by their own names; a vector goes by `observations`, or `actions`."""
    return key.removeprefix("observations/").removeprefix("actions/")


def _next(episodes: Iterator[Any], index: int) -> Any:
    """The library trusts its files: what breaks in it is a file that is not as it has to be."""
    try:
        return next(episodes)
    except (AssertionError, KeyError, TypeError, ValueError, OSError, StopIteration) as error:
        raise InvalidData(f"episode_{index}", f"cannot be read by minari {minari.__version__}: {_words(error)}") from None


def _opened(source: str) -> minari.MinariDataset:
    path = Path(source)
    folder = path.parent if path.is_file() else path
    data = folder / "data" if (folder / "data" / "metadata.json").exists() else folder
    try:
        return minari.MinariDataset(data) if path.exists() else minari.load_dataset(source)
    except FileNotFoundError as error:
        place = str(error).partition(" at ")[2].partition(". Use")[0]
        raise InvalidData(
            "",
            f"there is no Minari data set {source} on this machine{f' ({place})' if place else ''}: `minari download {source}` fetches it; "
            "MINARI_DATASETS_PATH says where they lie",
        ) from None
    except (AssertionError, KeyError, TypeError, ValueError, ImportError) as error:
        raise InvalidData("", f"{source} cannot be read by minari {minari.__version__}: {_words(error)}") from None


def _words(error: Exception) -> str:
    return str(error) or type(error).__name__
