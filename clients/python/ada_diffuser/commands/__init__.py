"""The command lines that drive environments through a server, and what they share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

DEFAULT_URL = "127.0.0.1:7777"


def add_server_arguments(parser: argparse.ArgumentParser) -> None:
    """Where the server is, and which face is used."""
    parser.add_argument("--url", default=DEFAULT_URL, help=f"host:port, grpc:// or http:// before it or not (default {DEFAULT_URL})")
    parser.add_argument("--face", choices=("grpc", "http"), help="(default: what the url says, else grpc)")
    parser.add_argument("--wait", type=float, default=10.0, metavar="S", help="wait so long for the server (default 10)")


def server_url(url: str, face: str | None) -> str:
    """`url` with the scheme of `face`; both faces stand on the same port."""
    scheme, _, address = url.rpartition("://")
    return f"{face or scheme or 'grpc'}://{address}"


def parse_settings(words: Sequence[str]) -> dict[str, str]:
    """`["a=1", "b=2"]` as a mapping; ValueError for a word without `=` and for a name that comes twice."""
    settings: dict[str, str] = {}
    for word in words:
        name, equals, value = (part.strip() for part in word.partition("="))
        if not equals:
            raise ValueError(f"{word!r} is not NAME=VALUE")
        if name in settings:
            raise ValueError(f"{name} is set twice")
        settings[name] = value
    return settings


@contextmanager
def progress_bar(steps: int, title: str) -> Iterator[Callable[[int], object]]:
    """A bar on stderr where that is a terminal."""
    from tqdm import tqdm

    with tqdm(total=steps, desc=title, unit="step", disable=None, leave=False) as bar:
        yield bar.update


def sentence(error: Exception) -> str:
    """What the user should read of an error."""
    if isinstance(error, ImportError):
        return f"{error}; install with: pip install 'ada-diffuser[mujoco]'"
    return str(error)
