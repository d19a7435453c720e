"""`ada-rollout`: drive an environment through a running server, and show what happened."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ada_diffuser.commands import (
    add_environment_arguments,
    add_server_arguments,
    add_trial_arguments,
    check_environment,
    client_of,
    environment_options,
    parse_settings,
    run_command,
    warm_start,
)
from ada_diffuser.commands.outputs import check_output, save_json
from ada_diffuser.commands.programs import Programs
from ada_diffuser.commands.progress import progress
from ada_diffuser.options import SamplerOptions

if TYPE_CHECKING:
    from ada_diffuser.rollout.readout import Reading

_ABOUT = """\
Drives an environment with a model on a running ada-server and prints what it earned and what it cost. --beside has other models
play the same episodes: a column of the table, a colour of the plot and a panel of the film for each.
Folders of --json, --plot and --film are made before the first episode, and one that fails does not keep back the others.
Episode e runs with seed SEED + e, in the environment and in the model, so the same command gives the same returns and all
models see the same episodes. Failed is what the environment's class calls failed (clients/python/README.md lists it).
Where the server goes away under way, the run waits for it, --budget seconds at most, and a line says how long it was away. On
a server with a store (ada-server --store) it then goes on as if nothing had been; on one without, its sessions are gone, and it ends.

--replay FILE needs no environment: it sends what a recording of ada-server (--record DIR) holds to a running server, in sessions
of its own, and holds every answer against the recorded one, bit for bit. It takes --url, --face, --wait, --budget, --json, --no-table
and --programs beside it; status 1 says that an answer differs, 3 that none does and not all could be compared."""

#: What goes with `--replay`.
_OF_REPLAY = {"replay", "programs", "url", "face", "wait", "budget", "json", "table"}
#: None differs, but not all could be compared.
_INCOMPLETE = 3


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0, 1 with a line on stderr, or 130 when interrupted; of `--replay` also 3."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    if arguments.replay is None:
        if arguments.env is None:
            parser.error("one of --env and --replay is required")
        return run_command("ada-rollout", lambda: _run(arguments))
    others = [name for name, value in vars(arguments).items() if name not in _OF_REPLAY and value != parser.get_default(name)]
    if others:
        parser.error(f"--{others[0].replace('_', '-')} does not go with --replay")
    status = 0

    def run() -> None:
        nonlocal status
        status = _replay(arguments)

    return run_command("ada-rollout", run) or status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("ada-rollout", description=_ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_environment_arguments(parser, required=False)
    add_server_arguments(parser)
    add_trial_arguments(parser)
    parser.add_argument("--model", default="", help="name or name@digest (default: the server's default model)")
    parser.add_argument("--beside", nargs="+", default=[], metavar="MODEL", help="other models, on the same episodes")
    parser.add_argument("--episodes", type=int, default=10, help="episodes to run (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first episode (default 0)")
    parser.add_argument("--vector", type=int, default=1, metavar="N", help="step N environments in lockstep by ActBatch")
    parser.add_argument(
        "--option", action="append", default=[], metavar="NAME=VALUE", help="sampling option, e.g. kappa=inf or told_goal=[0.5,0.1]"
    )
    parser.add_argument("--film", type=Path, metavar="GIF", help="film of the last episode")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="rewards, returns, true and read-out context")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="the numbers of the table and each episode's return; with --beside a list of them"
    )
    parser.add_argument("--no-table", dest="table", action="store_false", help="print no table")
    parser.add_argument(
        "--replay", type=Path, metavar="FILE", help="a recording of ada-server, or what `ada-server replay --export` prints of one"
    )
    parser.add_argument(
        "--programs", type=Path, metavar="DIR", help="where ada-server is, which reads recordings (default: PATH, target/release)"
    )
    return parser


def _replay(arguments: argparse.Namespace) -> int:
    """The status."""
    from ada_diffuser.recording import MAGIC, Recording, replay

    check_output("--json", arguments.json)
    with arguments.replay.open("rb") as file:
        is_binary = file.read(len(MAGIC)) == MAGIC
    if is_binary:
        lines = Programs.exported(arguments.replay, arguments.programs).splitlines()
        recording = Recording.read(lines, str(arguments.replay))
    else:
        recording = Recording.load(arguments.replay)
    with client_of(arguments) as client:
        client.wait_ready(arguments.wait)
        # A bar would need a package that nothing else here does.
        with progress(recording.acts, arguments.replay.name, "act", quiet=sys.stderr.isatty()) as advance:
            done = replay(client, recording, advance)
    if arguments.table:
        print(done, flush=True)
    if arguments.json:
        save_json(done.as_json(), arguments.json)
    return {"equal": 0, "different": 1}.get(done.verdict, _INCOMPLETE)


def _run(arguments: argparse.Namespace) -> None:
    options = SamplerOptions.parse(parse_settings(arguments.option))
    check_output("--json", arguments.json)
    check_output("--plot", arguments.plot, ".png", ".pdf", ".svg", ".jpg")
    check_output("--film", arguments.film, ".gif")
    check_environment(arguments)
    from ada_diffuser.rollout import Trial, check, evaluate
    from ada_diffuser.rollout.readout import read
    from ada_diffuser.rollout.report import table

    first = Trial(
        arguments.env,
        arguments.model,
        arguments.episodes,
        arguments.seed,
        arguments.vector,
        options,
        arguments.episode_steps,
        withhold_rewards=arguments.withhold_rewards,
        env_options=environment_options(arguments.env_option),
        warm_start=warm_start(arguments),
    )
    trials = [first, *(replace(first, model=model) for model in arguments.beside)]
    with client_of(arguments) as client:
        client.wait_ready(arguments.wait)
        steps = sum(trial.episodes * check(client, trial) for trial in trials)
        with progress(steps, first.env, "step") as advance:
            readings = [read(evaluate(client, trial, advance)) for trial in trials]
    if arguments.table:
        print(table(readings), flush=True)
    _write_all(arguments, readings)


def _write_all(arguments: argparse.Namespace, readings: Sequence[Reading]) -> None:
    """Every file that was asked for, whatever becomes of the others. Raises `ValueError` naming those that failed."""
    from ada_diffuser.rollout.film import Panel, save_film
    from ada_diffuser.rollout.plot import save_plot

    def save_film_or_say_why(path: Path) -> None:
        reason = save_film([Panel.last(one, one.result.model.name if arguments.beside else "") for one in readings], path)
        print(f"film: {path}" if reason is None else f"film: skipped, no way to render here ({reason})")

    def save_plot_and_say_so(path: Path) -> None:
        save_plot(readings, path)
        print(f"plot: {path}")

    numbers = [one.result.as_json() for one in readings]
    wanted: list[tuple[str, Path | None, Callable[[Path], None]]] = [
        ("--json", arguments.json, lambda path: save_json(numbers if arguments.beside else numbers[0], path)),
        ("--plot", arguments.plot, save_plot_and_say_so),
        ("--film", arguments.film, save_film_or_say_why),
    ]
    failures = []
    for flag, path, write in wanted:
        try:
            if path:
                write(path)
        except Exception as error:  # a picture may fail in any way, and the next file is wanted all the same
            failures.append(f"{flag} {path}: {error}")
    if failures:
        raise ValueError("not written: " + "; ".join(failures))


if __name__ == "__main__":
    sys.exit(main())
