"""`ada-collect`: let an expert fly an environment, and write what happened as a data set."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from ada_diffuser.commands import add_environment_arguments, environment_options, import_environments, run_command
from ada_diffuser.commands.outputs import check_output
from ada_diffuser.commands.progress import progress

if TYPE_CHECKING:
    from ada_diffuser.collect import Job
    from ada_diffuser.dataset import Episodes
    from ada_diffuser.experts import Expert, ExpertRecipe, Flight, PolicyBank

_ABOUT = """\
Let an expert that sees the hidden context fly an environment, and write the episodes as a D4RL-layout HDF5 file:
observations, actions (as executed), rewards, terminals, timeouts, infos/context, infos/action_noise; one row a step.
Beside it goes X.card.json: environment, options, seed, returns, expert, SHA-256, the command. infos/context is written where
`info["context"]` tells it.

An environment's class says what its expert is. A formula (its method `expert_action`) or a plan (`expert_plan`) flies at once. Where
there is none, policies are searched for here (Augmented Random Search, linear policies; for the cheetah one to two minutes for each
search, two at a time) and kept beside the data as X.expert.npz; a later call with the same environment, options, and expert settings
uses that file again. An environment that says nothing of it needs --expert: a function of yours that takes the observation and the
context (the attribute `context` of the environment; else its `goal`, which goes to infos/goal; else None), or random actions. The
same arguments give the same bytes.

--blind S has a share S of the episodes, drawn by the seed, flown by an expert that does not see the context: policies searched
for without it and kept as X.blind.npz, or the formula with the context's mean, where the class says what that is (`mean_context`).
infos/blind tells those episodes, the card has the returns of both kinds.

--play S has a share S of the episodes flown by the expert while it is told the context of another world, drawn as the true one is. Its
actions then say nothing of the true context, so that what comes of them does: data to find what is hidden in, and nothing to
imitate. infos/play tells those episodes; ada-trainer has no planner imitate them.

--quality takes the data of a learner in the place of an expert's, where the class keeps the search (walker2d does): medium is the policy
that earned about a third of what the best one does, medium-replay all that the search tried up to there, each policy in its own
episode (or --episodes of them), medium-expert half medium, half the best. They are snapshots of one run, that of X.expert.npz: give the
three data sets the same one with --expert.

--also FILE puts the episodes of another data set behind these, as play: a latent is then found in both, and the planner imitates these
alone. Data of other phases, gains and tasks, pooled for the latent and then narrowed to the target, is what meta-learning means here.

--session-episodes N makes sessions of N episodes that follow one another: the environment is reset with a seed where a session begins
and without one where it goes on, so that what is hidden may outlast an episode, as the wind of cheetah-wind-e does. infos/session has the
number of the session at each step. --blind and --play are then shares of the sessions, each of which is of one kind throughout. Where
N does not divide --episodes, the last session is shorter. Without it the environment is given a seed once, and nothing is written of
sessions."""

_EXAMPLES = """\
examples:
  ada-collect --env point-wind-s --episodes 400 --out data/point-wind-s.h5
  ada-collect --env cheetah-wind-s --episodes 300 --out data/cheetah-wind-s.h5
  ada-collect --env cheetah-wind-s --option gain=2 --episodes 300 --out data/strong-wind.h5
  ada-collect --env cheetah-vel-e --option 'targets=[0.5, 1.5, 2.5]' --out data/three-speeds.h5
  ada-collect --env cheetah-wind-s --expert data/cheetah-wind-s.expert.npz --seed 7 --out data/more.h5
  ada-collect --env hopper-gravity-e --blind 0.5 --action-noise 0.1,0.2 --out data/mixed.h5
  ada-collect --env cheetah-gale-s --play 0.75 --episodes 1200 --out data/gale.h5
  ada-collect --env cheetah-wind-e --session-episodes 10 --play 0.5 --episodes 600 --out data/sessions.h5
  ada-collect --env cheetah-wind-s --option gain=2 --episodes 150 --out data/strong-wind.h5
  ada-collect --env cheetah-wind-s --also data/strong-wind.h5 --episodes 300 --out data/pooled.h5
  ada-collect --env maze2d-umaze --option reset_target=true --episodes 500 --out data/maze2d-umaze.h5
  ada-collect --env walker2d --quality medium --episodes 300 --out data/walker2d-medium.h5
  ada-collect --env walker2d --quality medium-replay --expert data/walker2d-medium.expert.npz --out data/walker2d-medium-replay.h5
  ada-collect --env my_module:Mine-v0 --expert my_module:policy --out data/mine.h5
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0; 2 with a line on stderr that names what is wrong; 130 when interrupted. No data set is written then."""
    args = _parser().parse_args(argv)
    command = shlex.join(["ada-collect", *(sys.argv[1:] if argv is None else argv)])
    return run_command("ada-collect", lambda: _run(args, command), status=2)


def check_words(words: Sequence[str], where: str) -> None:
    """Raises `ValueError` that begins with `where` if a call with these words, and an environment, could not be read."""
    parser = _parser()

    def refuse(message: str) -> NoReturn:
        raise ValueError(f"{where}: ada-collect: {message}")

    parser.error = refuse  # type: ignore[method-assign]
    parser.parse_args(["--env", "any", "--out", "any.h5", *words])


def _run(args: argparse.Namespace, command: str) -> None:
    """Plan, expert, episodes, files; then the data card, or what matters of it."""
    _check_arguments(args)
    job = _plan(args)
    from ada_diffuser.collect import collect, data_card
    from ada_diffuser.dataset import save_card, save_episodes, with_play

    others = _others(args.also)
    expert = _expert(args, job, blind=False)
    blind = _expert(args, job, blind=True) if job.blind else None
    job, flown, quality = _flights(args, job, expert)
    with progress(job.episodes, "episodes", "episode", quiet=args.quiet) as advance:
        episodes, failed = collect(job, expert, advance, blind=blind, flights=flown)
    card = data_card(job, expert, episodes, failed, blind, quality)
    if others:
        episodes = with_play(episodes, list(others.values()))
        card["also"] = {name: {"episodes": len(other.returns()), "steps": len(other.rewards)} for name, other in others.items()}
    card["file"] = {"name": args.out.name, "sha256": save_episodes(episodes, args.out), "bytes": args.out.stat().st_size}
    card["command"] = command
    save_card(card, args.out)
    print(json.dumps(card, indent=2) if args.json else _summary(card, args.out))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "ada-collect", description=_ABOUT, epilog=_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_environment_arguments(parser)
    parser.add_argument("--out", required=True, type=Path, metavar="X.h5", help="the file to write; its folder is made")
    parser.add_argument("--episodes", type=int, default=300, metavar="N", help="how many (default 300)")
    parser.add_argument(
        "--session-episodes", type=int, metavar="N", help="another session begins every N episodes, and infos/session numbers them"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random here (default 0)")
    parser.add_argument("--option", action="append", dest="env_option", metavar="NAME=VALUE", help="another word for --env-option")
    parser.add_argument(
        "--action-noise",
        metavar="A,B,..",
        help="standard deviations; each episode draws one (default: as the environment's class says, else 0)",
    )
    expert = parser.add_argument_group("expert")
    expert.add_argument("--expert", metavar="E", help="fly this one: X.npz, MODULE:FUNCTION (of observation and context), or random")
    expert.add_argument(
        "--quality",
        metavar="Q",
        help="of a searched expert's way there: medium, medium-replay or medium-expert (default: the expert's best alone)",
    )
    expert.add_argument(
        "--blind", type=float, default=0.0, metavar="SHARE", help="share of the episodes flown without sight of the context (default 0)"
    )
    expert.add_argument(
        "--play", type=float, default=0.0, metavar="SHARE", help="share of the episodes flown under a false context (default 0)"
    )
    expert.add_argument("--blind-expert", metavar="E", help="fly this one there; as --expert")
    expert.add_argument("--expert-seed", type=int, default=0, metavar="N", help="of the searches (default 0)")
    expert.add_argument(
        "--expert-searches", type=int, metavar="N", help="searches for each policy (default: as the environment's class says, 3)"
    )
    expert.add_argument(
        "--expert-iterations", type=int, metavar="N", help="updates in a search (default: as the environment's class says, 300)"
    )
    parser.add_argument(
        "--also", action="append", default=[], type=Path, metavar="X.h5", help="episodes of another data set, as play; repeatable"
    )
    parser.add_argument("--json", action="store_true", help="print the data card instead of a summary")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    return parser


def _check_arguments(args: argparse.Namespace) -> None:
    for flag, least in (
        ("episodes", 1),
        ("session_episodes", 1),
        ("seed", 0),
        ("expert_seed", 0),
        ("expert_searches", 1),
        ("expert_iterations", 1),
    ):
        value = getattr(args, flag)
        if value is not None and value < least:
            raise ValueError(f"--{flag.replace('_', '-')} must be at least {least}")
    if not 0.0 <= args.blind <= 1.0:
        raise ValueError(f"--blind must be a share, 0 to 1, not {args.blind:g}")
    if not 0.0 <= args.play < 1.0:
        raise ValueError(f"--play must be a share below 1, not {args.play:g}: a planner needs something to imitate")
    if args.blind + args.play > 1.0:
        raise ValueError(f"--blind {args.blind:g} and --play {args.play:g} are more than all episodes")
    if args.quality:
        from ada_diffuser.experts import QUALITIES

        if args.quality not in QUALITIES:
            raise ValueError(f"--quality must be one of {', '.join(QUALITIES)}, not {args.quality!r}")
        if args.blind or args.play:
            raise ValueError("--quality is of what a learner saw, and takes neither --blind nor --play")
    if args.blind_expert and not args.blind:
        raise ValueError("--blind-expert flies no episode without --blind")
    check_output("--out", args.out, ".h5", ".hdf5")


def _plan(args: argparse.Namespace) -> Job:
    """What to fly. Raises `ValueError` naming the argument that is wrong, before anything is searched for."""
    environments = import_environments()
    from ada_diffuser.collect import Job

    options = environment_options(args.env_option)
    env = environments.make(args.env, episode_steps=args.episode_steps, **options)
    noise = _noise(args.action_noise) if args.action_noise else environments.action_noise(env)
    env_id = args.env if ":" in args.env else env.spec.id
    return Job(
        env_id, options, args.episodes, noise, args.seed, args.episode_steps, args.blind, args.play, session_episodes=args.session_episodes
    )


def _others(paths: Sequence[Path]) -> dict[str, Episodes]:
    """Data sets that go behind this one, by file name; read before anything is flown."""
    from ada_diffuser.dataset import load_episodes

    found = {}
    for path in paths:
        try:
            found[path.name] = load_episodes(path)
        except (OSError, KeyError) as error:
            raise ValueError(f"--also {path}: is no data set of ada-collect: {error}") from None
    return found


def _flights(args: argparse.Namespace, job: Job, expert: Expert) -> tuple[Job, Sequence[Flight] | None, dict[str, Any] | None]:
    """The job, who flies each of its episodes where a quality is wanted, and what the card says of it."""
    if not args.quality:
        return job, None, None
    from ada_diffuser.experts import ExpertRecipe, PolicyBank, flights

    if not isinstance(expert, PolicyBank):
        raise ValueError("--quality needs an expert that was searched for, and this one is a function")
    flown, quality = flights(expert, ExpertRecipe.from_json(expert.card["recipe"]), args.quality, job.episodes, job.seed)
    noise = job.noise if all(flight.noise is None for flight in flown) else (0.0,)
    return replace(job, episodes=len(flown), noise=noise), flown, quality


def _noise(text: str) -> tuple[float, ...]:
    try:
        levels = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--action-noise must be numbers with commas between, not {text!r}") from None
    if not all(0.0 <= level < float("inf") for level in levels):
        raise ValueError("--action-noise must not be negative or infinite")
    return levels


def _expert(args: argparse.Namespace, job: Job, *, blind: bool) -> Expert:
    """The one given, the formula, the file beside the output if its recipe is this one, or a new search."""
    from ada_diffuser import environments
    from ada_diffuser.experts import formula_of, import_expert, kept_expert, load_expert, make_expert, random_expert, recipe_for

    env = environments.make(job.env, episode_steps=job.episode_steps, **job.options)
    given = args.blind_expert if blind else args.expert
    if given == "random":
        return random_expert(env.action_space.low, env.action_space.high, job.seed)
    if given:
        return import_expert(given) if _is_function(given) else load_expert(Path(given))
    if formula := formula_of(env, blind=blind):
        return formula
    recipe = recipe_for(env, job.options, args.expert_seed, args.expert_searches, args.expert_iterations, blind=blind)
    word = "blind" if blind else "expert"

    def search(recipe: ExpertRecipe) -> PolicyBank:
        with progress(recipe.iterations, word, "iteration", quiet=args.quiet) as advance:
            return make_expert(recipe, advance)

    return kept_expert(recipe, args.out.with_name(f"{args.out.stem}.{word}.npz"), search)


def _is_function(text: str) -> bool:
    """MODULE:FUNCTION, and not a file in whose name there is a colon."""
    return ":" in text and not Path(text).exists()


def _summary(card: dict[str, Any], path: Path) -> str:
    returns = card["returns"]
    error = "" if returns["standard_error"] is None else f" +- {returns['standard_error']:.2f}"
    return (
        f"{path}: {card['episodes']} episodes, {card['steps']} steps; "
        f"return {returns['mean']:.2f}{error}, median {returns['median']:.2f}, {returns['failures']} failed\n"
        f"card: {path.with_suffix('.card.json')}"
    )


if __name__ == "__main__":
    sys.exit(main())
