"""`ada-evaluate`: models x settings on the same episodes through one running server, as one table."""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ada_diffuser.client import Client
from ada_diffuser.commands import add_server_arguments, parse_settings, progress_bar, sentence, server_url
from ada_diffuser.errors import AdaError
from ada_diffuser.messages import SamplerOptions

if TYPE_CHECKING:
    from ada_diffuser.rollout import Evaluation

_ABOUT = """\
Runs each model with each combination of settings over the same episodes (seeds SEED, SEED + 1, ...), all episodes of one
combination side by side through ActBatch, and prints a table of mean return and standard error, median, failures,
evaluations an act, and the latency of a batch. Results are written to --json as each combination ends.

  ada-evaluate --env cheetah-wind-s --models a,b --episodes 50 --seed 1000 --set kappa=0,0.1,inf --set streaming=true,false"""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0, or 1 with a line on stderr."""
    arguments = _parser().parse_args(argv)
    try:
        _run(arguments)
    except (AdaError, ValueError, OSError, ImportError) as error:
        print(f"ada-evaluate: {sentence(error)}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("ada-evaluate", description=_ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", required=True, help="short name (cheetah-wind-s, ...) or Gymnasium id")
    add_server_arguments(parser)
    parser.add_argument("--models", default="", help="names, with commas between (default: the server's default model)")
    parser.add_argument("--episodes", type=int, default=50, help="episodes of each combination (default 50)")
    parser.add_argument("--seed", type=int, default=1000, help="seed of the first episode (default 1000)")
    parser.add_argument("--vector", type=int, default=64, metavar="N", help="episodes side by side, at most (default 64)")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=V1,V2", help="values of a sampling option")
    parser.add_argument("--json", type=Path, metavar="FILE", help="a list with the numbers and returns of each combination")
    parser.add_argument("--markdown", action="store_true", help="print the table alone, no line as each combination ends")
    return parser


def combinations(words: Sequence[str]) -> Iterator[SamplerOptions]:
    """`["kappa=0,1", "streaming=true"]`: every choice of one value each. ValueError for a wrong one, before any is run."""
    settings = parse_settings(words)
    choices = [[(name, value.strip()) for value in values.split(",")] for name, values in settings.items()]
    yield from [SamplerOptions.parse(dict(choice)) for choice in itertools.product(*choices)]


def _run(arguments: argparse.Namespace) -> None:
    from ada_diffuser.environments import EPISODE_STEPS
    from ada_diffuser.rollout import Trial, evaluate
    from ada_diffuser.rollout.report import markdown

    trials = [
        Trial(arguments.env, model.strip(), arguments.episodes, arguments.seed, arguments.vector, options)
        for model in arguments.models.split(",")
        for options in combinations(arguments.set)
    ]
    results: list[Evaluation] = []
    with Client(server_url(arguments.url, arguments.face)) as client:
        client.wait_ready(arguments.wait)
        for n, trial in enumerate(trials, start=1):
            with progress_bar(trial.episodes * EPISODE_STEPS, f"{n}/{len(trials)} {trial.model or trial.env}") as progress:
                results.append(evaluate(client, trial, progress))
            if not arguments.markdown:
                print(_line(results[-1], f"{n}/{len(trials)}"), file=sys.stderr, flush=True)
            if arguments.json:
                arguments.json.write_text(json.dumps([result.as_json() for result in results], indent=1) + "\n", encoding="utf-8")
    print(markdown(results, list(parse_settings(arguments.set))))


def _line(result: Evaluation, which: str) -> str:
    settings = " ".join(f"{name}={value}" for name, value in result.trial.options.given().items())
    outcome = f"{result.mean_return:.2f} ± {result.standard_error:.2f}, {result.failures} failed, {result.wall_s:.1f} s"
    return " ".join(part for part in (which, result.model.name, settings, outcome) if part)


if __name__ == "__main__":
    sys.exit(main())
