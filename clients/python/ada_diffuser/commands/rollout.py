"""`ada-rollout`: drive an environment through a running server, and show what happened."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from ada_diffuser.client import Client
from ada_diffuser.commands import add_server_arguments, parse_settings, progress_bar, sentence, server_url
from ada_diffuser.errors import AdaError
from ada_diffuser.messages import SamplerOptions

_ABOUT = """\
Drives a registered environment with a model on a running ada-server and prints what it earned and what it cost.
Episode e runs with seed SEED + e, in the environment and in the model, so the same command gives the same returns and all
models see the same episodes. Failed is what the environment says failed: point-wind-s below -60 (a pilot that knows only the
mean wind: -47), the cheetahs below three quarters of what standing still earns (wind tasks -225)."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0, or 1 with a line on stderr."""
    arguments = _parser().parse_args(argv)
    try:
        _run(arguments)
    except (AdaError, ValueError, OSError, ImportError) as error:
        print(f"ada-rollout: {sentence(error)}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("ada-rollout", description=_ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, help="short name (cheetah-wind-s, ...) or Gymnasium id")
    add_server_arguments(parser)
    parser.add_argument("--model", default="", help="name or name@digest (default: the server's default model)")
    parser.add_argument("--episodes", type=int, default=10, help="episodes to run (default 10)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first episode (default 0)")
    parser.add_argument("--vector", type=int, default=1, metavar="N", help="step N environments in lockstep by ActBatch")
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE", help="sampling option, e.g. kappa=inf")
    parser.add_argument("--film", type=Path, metavar="GIF", help="film of the last episode")
    parser.add_argument("--plot", type=Path, metavar="PNG", help="rewards, returns, true and read-out context")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the numbers of the table and each episode's return")
    parser.add_argument("--no-table", dest="table", action="store_false", help="print no table")
    return parser


def _run(arguments: argparse.Namespace) -> None:
    # Here and not above: `--help` must work, and a run must say what to install, without the extra.
    from ada_diffuser.environments import EPISODE_STEPS
    from ada_diffuser.rollout import Trial, evaluate
    from ada_diffuser.rollout.readout import fit
    from ada_diffuser.rollout.report import table

    options = SamplerOptions.parse(parse_settings(arguments.option))
    trial = Trial(arguments.env, arguments.model, arguments.episodes, arguments.seed, arguments.vector, options)
    with Client(server_url(arguments.url, arguments.face)) as client:
        client.wait_ready(arguments.wait)
        with progress_bar(trial.episodes * EPISODE_STEPS, trial.env) as progress:
            result = evaluate(client, trial, progress)
    readout = fit(result.episodes)
    if arguments.table:
        print(table(result, readout))
    if arguments.json:
        arguments.json.write_text(json.dumps(result.as_json(), indent=1) + "\n", encoding="utf-8")
    if arguments.plot:
        from ada_diffuser.rollout.plot import save_plot

        save_plot(result, readout, arguments.plot)
        print(f"plot: {arguments.plot}")
    if arguments.film:
        from ada_diffuser.rollout.film import save_film

        reason = save_film(trial.env, result.episodes[-1], readout, arguments.film)
        print(f"film: {arguments.film}" if reason is None else f"film: skipped, no way to render here ({reason})")


if __name__ == "__main__":
    sys.exit(main())
