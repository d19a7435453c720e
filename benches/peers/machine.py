"""What the figures were taken on, and who else was at work there."""

from __future__ import annotations

import os
import platform
import resource
import time
from pathlib import Path
from typing import Any

# Above this share of the cores the figures are not worth much: threads that wait for each other suffer first, and PyTorch's most.
BUSY = 0.05


def pin(cores: int) -> list[int]:
    """Puts this process, and all that it starts, on the first of the cores that it may use."""
    if not hasattr(os, "sched_setaffinity"):
        return list(range(os.cpu_count() or 1))
    chosen = sorted(os.sched_getaffinity(0))[:cores]
    os.sched_setaffinity(0, chosen)
    return chosen


def describe(cores: list[int]) -> dict[str, Any]:
    """Processor, cores, PyTorch."""
    import torch

    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {"processor": names[0] if names else platform.processor(), "cores": len(cores), "torch": torch.__version__}


class Watch:
    """How much of these cores others use from now on."""

    def __init__(self, cores: list[int]) -> None:
        self._cores = {f"cpu{core}" for core in cores}
        self._wall, self._busy, self._own = time.monotonic(), self._busy_seconds(), _own_seconds()

    def others(self) -> float:
        """Their share, 0 to 1; what this process started must have ended. 0 where the system does not say."""
        wall, busy = time.monotonic() - self._wall, self._busy_seconds() - self._busy
        return max(0.0, busy - (_own_seconds() - self._own)) / max(1e-9, wall * len(self._cores))

    def _busy_seconds(self) -> float:
        stat = Path("/proc/stat")
        if not stat.exists():
            return 0.0
        rows = [line.split() for line in stat.read_text().splitlines()]
        # user, nice, system, (idle, waiting for a disk,) interrupts, soft interrupts, stolen
        ticks = sum(int(row[column]) for row in rows if row[0] in self._cores for column in (1, 2, 3, 6, 7, 8))
        return ticks / os.sysconf("SC_CLK_TCK")


def _own_seconds() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)
