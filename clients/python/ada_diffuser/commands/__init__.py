"""The command lines that drive environments through a server, and what they share."""

from __future__ import annotations

import argparse
import io
import json
import os
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ada_diffuser.client import Client
from ada_diffuser.commands.progress import saying
from ada_diffuser.errors import AdaError
from ada_diffuser.retry import RetryPolicy

if TYPE_CHECKING:
    from ada_diffuser.rollout.warm_start import WarmStart

DEFAULT_URL = "127.0.0.1:7777"
_ENV_HELP = "short name, as point-wind-s (a wrong one lists them all), Gymnasium id, or MODULE:ID to import it from"


def add_environment_arguments(parser: argparse.ArgumentParser, *, required: bool = True) -> None:
    """Which environment, its options, and how long its episodes are."""
    parser.add_argument("--env", required=required, metavar="NAME", help=_ENV_HELP)
    parser.add_argument(
        "--episode-steps", type=int, metavar="N", help="truncate episodes there (default: as the environment is registered)"
    )
    parser.add_argument(
        "--env-option", action="append", default=[], metavar="NAME=VALUE", help="option of the environment, value as JSON; repeatable"
    )


def add_trial_arguments(parser: argparse.ArgumentParser) -> None:
    """How the server is asked."""
    parser.add_argument(
        "--withhold-rewards", action="store_true", help="do not report rewards: what is the model worth where nobody measures them?"
    )
    parser.add_argument(
        "--warm-start",
        metavar="FILE[:EPISODE]",
        help="open each session with the steps of this episode of a data set (default: its last), on which the latent looks back; the model"
        " must be trained on sessions, and the steps should be of the hidden context that it is to meet",
    )


def warm_start(arguments: argparse.Namespace) -> WarmStart | None:
    """What `--warm-start` names, read. Raises `ValueError`, before a server is waited for."""
    if arguments.warm_start is None:
        return None
    from ada_diffuser.rollout.warm_start import WarmStart

    try:
        return WarmStart.parse(arguments.warm_start)
    except (OSError, KeyError) as error:
        raise ValueError(f"--warm-start {arguments.warm_start}: is no data set of ada-collect: {error}") from None


def add_server_arguments(parser: argparse.ArgumentParser) -> None:
    """Where the server is, and which face is used."""
    parser.add_argument("--url", default=DEFAULT_URL, help=f"host:port, grpc:// or http:// before it or not (default {DEFAULT_URL})")
    parser.add_argument("--face", choices=("grpc", "http"), help="(default: what the url says, else grpc)")
    parser.add_argument("--wait", type=seconds, default=10.0, metavar="S", help="wait so long for the server to be there (default 10)")
    parser.add_argument(
        "--budget",
        type=seconds,
        default=RetryPolicy.budget_s,
        metavar="S",
        help="give up when a call is not answered within so long, as while the server is started again (default %(default)g)",
    )


def client_of(arguments: argparse.Namespace) -> Client:
    """The client that `add_server_arguments` describe; nothing is sent yet."""
    return Client(server_url(arguments.url, arguments.face), retry=RetryPolicy(budget_s=arguments.budget))


def seconds(text: str) -> float:
    if not 0 <= float(text) < float("inf"):
        raise ValueError
    return float(text)


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


def environment_options(words: Sequence[str]) -> dict[str, Any]:
    """`["gain=2", "targets=lilac"]` as keyword arguments of an environment: values are JSON where they are JSON, else the word itself."""
    return {name: _value(text) for name, text in parse_settings(words).items()}


def _value(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def run_command(program: str, run: Callable[[], object], *, status: int = 1, extra: str = "mujoco") -> int:
    """Runs the body of a command: 0; `status` with one sentence on stderr for what the user can mend; 130 when interrupted.

    `extra` is the one of this package's that has what the command imports.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal that cannot spell the results still gets them
    # Modules of the caller's (MODULE:ID) are found in the working directory, as by `python -m`; installed ones come first.
    sys.path.append(os.getcwd())
    try:
        with saying(program):
            run()
        sys.stdout.flush()
    except BrokenPipeError:
        # Nobody reads any more (`| head`). Python flushes stdout once more at exit, and would complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return status
    except (AdaError, ValueError, OSError, ImportError) as error:
        print(f"{program}: {_sentence(error, extra)}", file=sys.stderr)
        return status
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    finally:
        sys.path.pop()
    return 0


def import_environments() -> ModuleType:
    """The simulators, only where they are used: `--help` must work, and a run must say what to install, without the extra."""
    try:
        from ada_diffuser import environments
    except RuntimeError as error:
        raise ValueError(f"MuJoCo cannot be loaded: {error}") from error
    return environments


def check_environment(arguments: argparse.Namespace) -> None:
    """Raises `ValueError` for an environment that cannot be made with its options, before a server is waited for."""
    options = environment_options(arguments.env_option)
    import_environments().make(arguments.env, episode_steps=arguments.episode_steps, **options).close()


def _sentence(error: Exception, extra: str) -> str:
    """What the user should read of an error, on one line."""
    if isinstance(error, ImportError):
        return f"{error}; install with: pip install 'ada-diffuser[{extra}]'"
    return " ".join(str(error).split())
