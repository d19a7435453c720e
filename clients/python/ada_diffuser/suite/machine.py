"""The machine that a number was measured on."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any


def machine(cells_at_once: int) -> dict[str, Any]:
    """Model of the processor, the widest vectors that it can, its cores, and how many cells shared them, one core for each."""
    model, flags = _processor(Path("/proc/cpuinfo"))
    vectors = next((name for name, flag in (("avx512", "avx512f"), ("avx2", "avx2")) if flag in flags), platform.machine())
    return {"cpu": model, "vectors": vectors, "cores": os.cpu_count(), "cells_at_once": cells_at_once}


def _processor(path: Path) -> tuple[str, set[str]]:
    """As Linux tells them, of the first core."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine(), set()
    facts = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in text.split("\n\n")[0].splitlines())}
    return facts.get("model name", platform.machine()), set(facts.get("flags", "").split())
