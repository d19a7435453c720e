"""What is imported where it is used, so that the package works without it."""

from __future__ import annotations

import importlib
import io
from contextlib import redirect_stderr
from types import ModuleType


def robotics(module: str) -> ModuleType:
    """A module of gymnasium-robotics. Raises `ImportError` that says what to install."""
    try:
        with redirect_stderr(io.StringIO()):  # the package tells whoever imports it of rewards of robot hands
            return importlib.import_module(f"gymnasium_robotics.{module}")
    except ModuleNotFoundError as error:
        raise ImportError(f"{error}; install with: pip install 'ada-diffuser[robotics]'") from error
