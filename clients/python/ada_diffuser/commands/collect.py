"""`ada-collect`: let an expert fly an environment, and write what happened as a data set."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ada_diffuser.commands import parse_settings, sentence

# The simulators are imported where they are used: `--help` must work, and a run must say what to install, without the extra.
if TYPE_CHECKING:
    from ada_diffuser.collect import Job
    from ada_diffuser.experts import Expert, ExpertRecipe

_ABOUT = """\
Let an expert that sees the hidden context fly an environment, and write the episodes as a D4RL-layout HDF5 file:
observations, actions (as executed), rewards, terminals, timeouts, infos/context, infos/action_noise; one row a step.
Beside it goes X.card.json: environment, options, seed, returns, expert, SHA-256, the command.

The expert of PointWind is a formula. The cheetah's are trained here by Augmented Random Search (linear policies,
one to two minutes for each search, two at a time) and kept beside the data as X.expert.npz; a later call with the same
environment, options, and expert settings uses that file again. The same arguments give the same bytes."""

_EXAMPLES = """\
examples:
  ada-collect --env point-wind-s --episodes 400 --out data/point-wind-s.h5
  ada-collect --env cheetah-wind-s --episodes 300 --out data/cheetah-wind-s.h5
  ada-collect --env cheetah-wind-s --option gain=2 --episodes 300 --out data/strong-wind.h5
  ada-collect --env cheetah-vel-e --option 'targets=[0.5, 1.5, 2.5]' --out data/three-speeds.h5
  ada-collect --env cheetah-wind-s --expert data/cheetah-wind-s.expert.npz --seed 7 --out data/more.h5
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0; 2 with a line on stderr that names what is wrong; 130 when interrupted. No data set is written then."""
    args = _parser().parse_args(argv)
    command = shlex.join(["ada-collect", *(sys.argv[1:] if argv is None else argv)])
    try:
        _check_numbers(args)
        card = _run(args, command)
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"ada-collect: {sentence(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("ada-collect: interrupted, no data set written", file=sys.stderr)
        return 130
    print(json.dumps(card, indent=2) if args.json else _summary(card, args.out))
    return 0


def _run(args: argparse.Namespace, command: str) -> dict[str, Any]:
    """Plan, expert, episodes, files; returns the data card."""
    from ada_diffuser.collect import collect, data_card
    from ada_diffuser.dataset import save_card, save_episodes

    job, recipe = _plan(args)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    expert = _expert(args, recipe)
    episodes, failures = collect(job, expert, _bar(args.quiet))
    card = data_card(job, expert, episodes, failures)
    card["file"] = {"name": args.out.name, "sha256": save_episodes(episodes, args.out), "bytes": args.out.stat().st_size}
    card["command"] = command
    save_card(card, args.out)
    return card


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "ada-collect", description=_ABOUT, epilog=_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--env", required=True, metavar="NAME", help="point-wind-s, cheetah-wind-s, cheetah-wind-e, cheetah-vel-e, or its Gymnasium id"
    )
    parser.add_argument("--out", required=True, type=Path, metavar="X.h5", help="the file to write; its folder is made")
    parser.add_argument("--episodes", type=int, default=300, metavar="N", help="episodes of 200 steps (default 300)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random here (default 0)")
    parser.add_argument(
        "--option", action="append", default=[], metavar="NAME=VALUE", help="option of the environment, value as JSON; repeatable"
    )
    parser.add_argument(
        "--action-noise", metavar="A,B,..", help="standard deviations; each episode draws one (point 0.1,0.2,0.3; cheetah 0,0.05,0.1)"
    )
    expert = parser.add_argument_group("expert")
    expert.add_argument("--expert", type=Path, metavar="X.npz", help="fly this one instead of training one")
    expert.add_argument("--expert-seed", type=int, default=0, metavar="N", help="of the searches (default 0)")
    expert.add_argument("--expert-searches", type=int, default=3, metavar="N", help="searches for each policy (default 3)")
    expert.add_argument("--expert-iterations", type=int, default=300, metavar="N", help="updates in a search (default 300)")
    parser.add_argument("--json", action="store_true", help="print the data card instead of a summary")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    return parser


def _check_numbers(args: argparse.Namespace) -> None:
    for flag, least in (("episodes", 1), ("seed", 0), ("expert_seed", 0), ("expert_searches", 1), ("expert_iterations", 1)):
        if getattr(args, flag) < least:
            raise ValueError(f"--{flag.replace('_', '-')} must be at least {least}")
    if args.out.suffix not in (".h5", ".hdf5"):
        raise ValueError(f"--out must end in .h5 or .hdf5, not {args.out.name!r}")


def _plan(args: argparse.Namespace) -> tuple[Job, ExpertRecipe | None]:
    """What to fly and, where the expert is to be searched for, how. Raises `ValueError` naming the argument that is wrong."""
    from ada_diffuser import environments
    from ada_diffuser.collect import Job, default_noise
    from ada_diffuser.experts import recipe_for
    from ada_diffuser.experts.ars import ArsSettings

    options = {name: _value(text) for name, text in parse_settings(args.option).items()}
    env = environments.make(args.env, **options)
    noise = _noise(args.action_noise) if args.action_noise else default_noise(env)
    ars = ArsSettings(iterations=args.expert_iterations)
    recipe = None if args.expert else recipe_for(env, options, args.expert_seed, args.expert_searches, ars)
    return Job(env.spec.id, options, args.episodes, noise, args.seed), recipe


def _value(text: str) -> Any:
    """JSON where it is JSON, else the word itself."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        return text


def _noise(text: str) -> tuple[float, ...]:
    try:
        levels = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--action-noise must be numbers with commas between, not {text!r}") from None
    if not all(0.0 <= level < float("inf") for level in levels):
        raise ValueError("--action-noise must not be negative or infinite")
    return levels


def _expert(args: argparse.Namespace, recipe: ExpertRecipe | None) -> Expert:
    """The file given, the formula, the file beside the output if its recipe is this one, or a new search."""
    from ada_diffuser.experts import AnalyticPilot, load_expert, make_expert, save_expert

    if args.expert:
        return load_expert(args.expert)
    if recipe is None:
        return AnalyticPilot()
    cache = args.out.with_name(f"{args.out.stem}.expert.npz")
    if cache.exists():
        expert = load_expert(cache)
        if expert.card["recipe"] == json.loads(json.dumps(recipe.to_json())):
            return expert
        print(f"{cache} has another recipe; training anew", file=sys.stderr)
    with _search_bar(args.quiet) as show:
        expert = make_expert(recipe, show)
    save_expert(expert, cache)
    return expert


@contextmanager
def _search_bar(quiet: bool) -> Iterator[Callable[[int, int], None]]:
    from tqdm import tqdm

    with tqdm(desc="expert", unit="iteration", disable=quiet, file=sys.stderr) as bar:

        def show(done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.refresh()

        yield show


def _bar(quiet: bool) -> Callable[[range], Iterator[int]]:
    from tqdm import tqdm

    return lambda episodes: tqdm(episodes, desc="episodes", unit="episode", disable=quiet, file=sys.stderr)


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
