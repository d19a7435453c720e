"""`ada-evaluate`: models x settings on the same episodes through one running server, as one table; or a choice of defaults."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ada_diffuser.commands import (
    add_environment_arguments,
    add_server_arguments,
    add_trial_arguments,
    check_environment,
    choose,
    client_of,
    environment_options,
    parse_settings,
    run_command,
    warm_start,
)
from ada_diffuser.commands.outputs import check_output, save_json
from ada_diffuser.commands.progress import progress
from ada_diffuser.options import SamplerOptions, several, word

if TYPE_CHECKING:
    from ada_diffuser.rollout import Evaluation, Trial
    from ada_diffuser.rollout.readout import Reading

_ABOUT = f"""\
Runs each model with each combination of settings over the same episodes (seeds SEED, SEED + 1, ...), all episodes of one
combination side by side through ActBatch, and prints a table of mean return and standard error, median, failures,
evaluations an act, and the latency of a batch. Models, settings and the folder of --json are checked before the first
episode; results are written to --json as each combination ends, and what was finished is printed whatever ends the command.

The standard error is that over episodes, and says nothing of another training. Models that are training seeds of one recipe
(NAME-seed0, NAME-seed1, ..., as ada-trainer names them) get a row more together, with the standard error over the seeds.

  ada-evaluate --env cheetah-wind-s --models a,b --episodes 50 --seed 1000 --set kappa=0,0.1,inf --set streaming=true,false

--session-episodes N runs the episodes in sessions of N that follow one another, over which what is hidden may last: session k has seed
SEED + k, between its episodes the environment is reset without a seed, and the model goes on looking back on the episodes before, which
it must have been trained to do. A second table has the returns by the episode's place in the session. All standard errors are over
sessions then. Where N does not divide --episodes, the last session is shorter. --forget has the model begin each episode anew, in the same
contexts: for comparison, and for a model that was trained on episodes one by one.

  ada-evaluate --env cheetah-wind-e --models a --episodes 48 --session-episodes 8
  ada-evaluate --env cheetah-wind-e --models a --episodes 48 --session-episodes 8 --forget

--readout adds what the latents say of the true context on these episodes, the agent's own: the squared error of a linear map
from the latent at each act (fitted on the first half of the episodes, judged on the others) over the context's variance, by the
step of the act in its episode. 0 knows all, 1 nothing but the mean; the errors are over episodes. Of sessions, half of which are
fitted, the first episodes and the later ones are judged each by themselves. And k-means with five groups of
latents, held against five bins of the context with as many acts in each: adjusted Rand index, purity. With kappa above 0 the latent
is the refined one, which the window itself had a part in; --set kappa=0 shows the filter's.

--choose CHECKPOINT chooses a checkpoint's sampling defaults on validation episodes (by default seeds {choose.FIRST_SEED} on; the tables of
models/README.md are of seeds from 1000 on). No server need run: the grid has keys of [restart], which no session can choose, so
variants of the checkpoint are written to a temporary folder and served on loopback while the command runs. The grid is streaming,
kappa, temperature, latent_jump and cold_distance, with the checkpoint's own values and some on either side; --set takes the place of a
key's values (latent_kl, renoise_distance and the other sampling options too).
{choose.RULE}
A setting that is more than two standard errors below the best cold one after a quarter of the episodes is run no further (far below), nor
is one that needs more evaluations than one that qualifies (dearer).

  ada-evaluate --env cheetah-vel-e --choose runs/cheetah-vel-e-seed3 --json chosen.json --write shipped/cheetah-vel-e-seed3"""


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
    parser.add_argument("--seed", type=int, help=f"seed of the first episode (default 1000; {choose.FIRST_SEED} with --choose)")
    parser.add_argument("--vector", type=int, default=64, metavar="N", help="episodes, or sessions, side by side, at most (default 64)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=V1,V2", help="values of a sampling option; a list is one in brackets"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="a list with the numbers and returns of each combination and recipe")
    parser.add_argument("--markdown", action="store_true", help="print the table alone, no line as each combination ends")
    sessions = parser.add_argument_group("sessions")
    sessions.add_argument(
        "--session-episodes", type=int, default=1, metavar="N", help="so many of the episodes follow one another (default 1: none does)"
    )
    sessions.add_argument("--forget", action="store_true", help="let the model forget the episodes before, for comparison")
    readout = parser.add_argument_group("what the latents know")
    readout.add_argument("--readout", action="store_true", help="also read the true context out of the latents, by age in the episode")
    readout.add_argument("--plot", type=Path, metavar="PNG", help="with --readout: latents on two axes, coloured by the true context")
    defaults = parser.add_argument_group("choosing defaults")
    defaults.add_argument("--choose", type=Path, metavar="CHECKPOINT", help="choose this directory's sampling defaults, by the rule above")
    defaults.add_argument("--write", type=Path, metavar="OUT", help="with --choose: let `ada-trainer defaults` write the choice to OUT")
    defaults.add_argument(
        "--programs", type=Path, metavar="DIR", help="with --choose: where ada-server and ada-trainer are (default: PATH, target/release)"
    )
    return parser


def combinations(words: Sequence[str]) -> Iterator[SamplerOptions]:
    """`["kappa=0,1", "told_goal=[0,1],[1,0]"]`: every choice of one value each. ValueError for a wrong one, before any is run."""
    settings = parse_settings(words)
    choices = [[(name, value) for value in several(values)] for name, values in settings.items()]
    yield from [SamplerOptions.parse(dict(choice)) for choice in itertools.product(*choices)]


def _run(arguments: argparse.Namespace) -> None:
    if arguments.seed is None:
        arguments.seed = choose.FIRST_SEED if arguments.choose else 1000
    for flag, needs in (("write", "choose"), ("plot", "readout")):
        if getattr(arguments, flag) and not getattr(arguments, needs):
            raise ValueError(f"--{flag} belongs to --{needs}")
    if arguments.session_episodes < 1:
        raise ValueError("--session-episodes must be at least 1")
    if arguments.forget and arguments.session_episodes == 1:
        raise ValueError("--forget belongs to --session-episodes: an episode by itself follows none")
    if not arguments.choose:
        return _evaluate(arguments)
    if arguments.readout:
        raise ValueError("--choose and --readout are two commands: choose first, then read")
    if arguments.session_episodes > 1:
        raise ValueError("--choose compares settings episode by episode, and takes no --session-episodes")
    choose.run(arguments)


def _evaluate(arguments: argparse.Namespace) -> None:
    check_output("--json", arguments.json)
    check_output("--plot", arguments.plot, ".png", ".pdf", ".svg", ".jpg")
    settings = list(combinations(arguments.set))
    models = [model.strip() for model in arguments.models.split(",")]
    if len(models) > 1 and not all(models):
        raise ValueError(f"--models {arguments.models!r} has an empty name")
    check_environment(arguments)
    begins_with = warm_start(arguments)
    from ada_diffuser.rollout import Trial

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
            session_episodes=arguments.session_episodes,
            forget=arguments.forget,
            env_options=environment_options(arguments.env_option),
            warm_start=begins_with,
        )
        for model in models
        for options in settings
    ]
    results: list[Evaluation] = []
    readings: list[Reading] = []
    try:
        _run_all(arguments, trials, results, readings)
    finally:
        _tell(arguments, results, readings)


def _tell(arguments: argparse.Namespace, results: Sequence[Evaluation], readings: Sequence[Reading]) -> None:
    from ada_diffuser.rollout.report import markdown, readout_table, session_table

    settings = list(parse_settings(arguments.set))
    if results:
        print(markdown(results, settings), flush=True)
    if results and arguments.session_episodes > 1:
        print(f"\n{session_table(results, settings)}", flush=True)
    if readings:
        print(f"\n{readout_table(readings, settings)}", flush=True)
    if readings and arguments.plot:
        from ada_diffuser.rollout.plot import save_latents

        save_latents(readings, arguments.plot)
        print(f"plot: {arguments.plot}")


def _run_all(arguments: argparse.Namespace, trials: Sequence[Trial], results: list[Evaluation], readings: list[Reading]) -> None:
    """Appends to `results` and `readings` as each trial ends, so that the caller has them whatever ends the rest."""
    from ada_diffuser.rollout import check, evaluate
    from ada_diffuser.rollout.readout import read
    from ada_diffuser.rollout.seeds import by_recipe

    with client_of(arguments) as client:
        client.wait_ready(arguments.wait)
        steps = [trial.episodes * check(client, trial) for trial in trials]
        for n, trial in enumerate(trials, start=1):
            which = f"{n}/{len(trials)}"
            with progress(steps[n - 1], f"{which} {trial.model or trial.env}", "step") as advance:
                results.append(evaluate(client, trial, advance))
            if not arguments.markdown:
                print(_line(results[-1], which), file=sys.stderr, flush=True)
            if arguments.readout:
                readings.append(read(results[-1]))
            if arguments.json:
                save_json([*_entries(results, readings), *(group.as_json() for group in by_recipe(results))], arguments.json)


def _entries(results: Sequence[Evaluation], readings: Sequence[Reading]) -> list[dict[str, Any]]:
    if not readings:
        return [result.as_json() for result in results]
    return [result.as_json() | reading.as_json() for result, reading in zip(results, readings, strict=True)]


def _line(result: Evaluation, which: str) -> str:
    from ada_diffuser.rollout.report import outcome

    settings = " ".join(f"{name}={word(value)}" for name, value in result.trial.options.given().items())
    return " ".join(part for part in (which, result.model.name, settings, outcome(result)) if part)


if __name__ == "__main__":
    sys.exit(main())
