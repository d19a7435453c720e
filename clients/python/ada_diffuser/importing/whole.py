"""Where an episode ends that a source keeps for itself: at its last step, whatever its flags say before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass
class EpisodeEnds:
    """Flags of whole episodes, and what is to be said of them: `what` an episode is called there, and `flag` what marks its end."""

    what: str
    flag: str
    early: int = 0
    unmarked: int = 0

    def of(self, terminals: np.ndarray, timeouts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(steps,) bool each, true at the last step alone: the task ended there if it says so, else the clock or the recording did."""
        last = np.arange(len(terminals)) == len(terminals) - 1
        self.early += bool((terminals | timeouts)[:-1].any())
        self.unmarked += not (terminals | timeouts)[-1]
        ended = last & terminals
        return ended, last & ~ended

    def notes(self) -> list[str]:
        found = []
        if self.early:
            found.append(f"{self.early} {self.what}(s) have `{self.flag}` before their last step, and were not cut there")
        if self.unmarked:
            found.append(f"{self.unmarked} {self.what}(s) end without `{self.flag}`: their last step counts as a timeout")
        return found
