"""`ada-evaluate`: models x settings on the same episodes through one running server, as one table."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ada_diffuser.client import Client
from ada_diffuser.commands import (
    add_environment_arguments,
    add_server_arguments,
    add_trial_arguments,
    check_environment,
    parse_settings,
    run_command,
    server_url,
)
from ada_diffuser.commands.outputs import check_output, save_json
from ada_diffuser.commands.progress import progress
from ada_diffuser.messages import SamplerOptions

if TYPE_CHECKING:
    from ada_diffuser.rollout import Evaluation, Trial

_ABOUT = """\
Runs each model with each combination of settings over the same episodes (seeds SEED, SEED + 1, ...), all episodes of one
combination side by side through ActBatch, and prints a table of mean return and standard error, median, failures,
evaluations an act, and the latency of a batch. Models, settings and the folder of --json are checked before the first
episode; results are written to --json as each combination ends, and what was finished is printed whatever ends the command.

The standard error is that over episodes, and says nothing of another training. Models that are training seeds of one recipe
(NAME-seed0, NAME-seed1, ..., as ada-trainer names them) get a row more together, with the standard error over the seeds.

  ada-evaluate --env cheetah-wind-s --models a,b --episodes 50 --seed 1000 --set kappa=0,0.1,inf --set streaming=true,false"""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0, 1 with a line on stderr, or 130 when interrupted."""
    arguments = _parser().parse_args(argv)
    return run_command("ada-evaluate", lambda: _run(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("ada-evaluate", description=_ABOUT, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_environment_arguments(parser)
    add_server_arguments(parser)
    add_trial_arguments(parser)
    parser.add_argument("--models", default="", help="names, with commas between (default: the server's default model)")
    parser.add_argument("--episodes", type=int, default=50, help="episodes of each combination (default 50)")
    parser.add_argument("--seed", type=int, default=1000, help="seed of the first episode (default 1000)")
    parser.add_argument("--vector", type=int, default=64, metavar="N", help="episodes side by side, at most (default 64)")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=V1,V2", help="values of a sampling option")
    parser.add_argument("--json", type=Path, metavar="FILE", help="a list with the numbers and returns of each combination and recipe")
    parser.add_argument("--markdown", action="store_true", help="print the table alone, no line as each combination ends")
    return parser


def combinations(words: Sequence[str]) -> Iterator[SamplerOptions]:
    """`["kappa=0,1", "streaming=true"]`: every choice of one value each. ValueError for a wrong one, before any is run."""
    settings = parse_settings(words)
    choices = [[(name, value.strip()) for value in values.split(",")] for name, values in settings.items()]
    yield from [SamplerOptions.parse(dict(choice)) for choice in itertools.product(*choices)]


def _run(arguments: argparse.Namespace) -> None:
    check_output("--json", arguments.json)
    settings = list(combinations(arguments.set))
    models = [model.strip() for model in arguments.models.split(",")]
    if len(models) > 1 and not all(models):
        raise ValueError(f"--models {arguments.models!r} has an empty name")
    check_environment(arguments)
    from ada_diffuser.rollout import Trial
    from ada_diffuser.rollout.report import markdown

    trials = [
        Trial(
            arguments.env,
            model,
            arguments.episodes,
            arguments.seed,
            arguments.vector,
            options,
            arguments.episode_steps,
            withhold_rewards=arguments.withhold_rewards,
        )
        for model in models
        for options in settings
    ]
    results: list[Evaluation] = []
    try:
        _run_all(arguments, trials, results)
    finally:
        if results:
            print(markdown(results, list(parse_settings(arguments.set))), flush=True)


def _run_all(arguments: argparse.Namespace, trials: Sequence[Trial], results: list[Evaluation]) -> None:
    """Appends to `results` as each trial ends, so that the caller has them whatever ends the rest."""
    from ada_diffuser.rollout import check, evaluate
    from ada_diffuser.rollout.seeds import by_recipe

    with Client(server_url(arguments.url, arguments.face)) as client:
        client.wait_ready(arguments.wait)
        steps = [trial.episodes * check(client, trial) for trial in trials]
        for n, trial in enumerate(trials, start=1):
            which = f"{n}/{len(trials)}"
            with progress(steps[n - 1], f"{which} {trial.model or trial.env}", "step") as advance:
                results.append(evaluate(client, trial, advance))
            if not arguments.markdown:
                print(_line(results[-1], which), file=sys.stderr, flush=True)
            if arguments.json:
                save_json([found.as_json() for found in [*results, *by_recipe(results)]], arguments.json)


def _line(result: Evaluation, which: str) -> str:
    settings = " ".join(f"{name}={value}" for name, value in result.trial.options.given().items())
    outcome = f"{result.mean_return:.2f} ± {result.standard_error:.2f}, {result.failures} failed, {result.wall_s:.1f} s"
    return " ".join(part for part in (which, result.model.name, settings, outcome) if part)


if __name__ == "__main__":
    sys.exit(main())
