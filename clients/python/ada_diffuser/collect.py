"""`ada-collect`: let an expert fly an environment, and write what happened as a data set."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

EXTRA_HINT = 'ada-collect needs the simulators: pip install "./clients/python[mujoco]"'
try:
    import gymnasium as gym
    from tqdm import tqdm

    from . import environments
    from .dataset import Episodes, card_path, save_card, save_episodes
    from .experts import AnalyticPilot, Expert, ExpertRecipe, load_expert, make_expert, recipe_for, save_expert
    from .experts.ars import ArsSettings
except ModuleNotFoundError as error:
    sys.exit(f"{error}. {EXTRA_HINT}")

NOISE_POINT = (0.1, 0.2, 0.3)
NOISE_CHEETAH = (0.0, 0.05, 0.1)

DESCRIPTION = """\
Let an expert that sees the hidden context fly an environment, and write the episodes as a D4RL-layout HDF5 file:
observations, actions (as executed), rewards, terminals, timeouts, infos/context, infos/action_noise; one row a step.
Beside it goes X.card.json: environment, options, seed, returns, expert, SHA-256, the command.

The expert of PointWind is a formula. The cheetah's are trained here by Augmented Random Search (linear policies,
about a minute for each search, two at a time) and kept beside the data as X.expert.npz; a later call with the same
environment, options, and expert settings uses that file again. The same arguments give the same bytes."""

EXAMPLES = """\
examples:
  ada-collect --env point-wind-s --episodes 400 --out data/point-wind-s.h5
  ada-collect --env cheetah-wind-s --episodes 300 --out data/cheetah-wind-s.h5
  ada-collect --env cheetah-wind-s --option gain=2 --episodes 300 --out data/strong-wind.h5
  ada-collect --env cheetah-vel-e --option 'targets=[0.5, 1.5, 2.5]' --out data/three-speeds.h5
  ada-collect --env cheetah-wind-s --expert data/cheetah-wind-s.expert.npz --seed 7 --out data/more.h5
"""


@dataclass(frozen=True)
class Job:
    """What to fly, apart from the expert.

    Attributes:
        env: short name or Gymnasium id.
        options: keyword arguments of the environment.
        episodes: how many.
        noise: standard deviations of action noise; each episode draws one.
        seed: of the environment, the noise and the choice among `noise`.
    """

    env: str
    options: dict[str, Any]
    episodes: int
    noise: tuple[float, ...]
    seed: int


def collect(job: Job, expert: Expert, progress: Callable[[range], Iterator[int]] = iter) -> tuple[Episodes, int]:
    """Fly the episodes of one session; returns them and how many failed. A pure function of its arguments."""
    env = environments.make(job.env, **job.options)
    env_seed, noise_seed = np.random.SeedSequence(job.seed).generate_state(2)
    rng = np.random.default_rng(noise_seed)
    flown, failures = [], 0
    for episode in progress(range(job.episodes)):
        std = float(rng.choice(job.noise))
        flown.append(_fly(env, expert, std, rng, int(env_seed) if episode == 0 else None))
        failures += env.unwrapped.failed(float(flown[-1].rewards.sum()))
    env.close()
    columns = {name: np.concatenate([getattr(e, name) for e in flown]) for name in Episodes.__dataclass_fields__}
    return Episodes(**columns), failures


def _fly(env: gym.Env, expert: Expert, std: float, rng: np.random.Generator, seed: int | None) -> Episodes:
    """One episode with action noise `std`."""
    observation, _ = env.reset(seed=seed)
    low, high = env.action_space.low, env.action_space.high
    steps: list[tuple[Any, ...]] = []
    ended = False
    while not ended:
        wanted = expert.act(observation, env.unwrapped.context)
        action = np.clip(wanted + std * rng.standard_normal(wanted.shape), low, high).astype(np.float32)
        following, reward, terminal, timeout, info = env.step(action)
        steps.append((observation, action, reward, terminal, timeout, info["context"], std))
        observation, ended = following, terminal or timeout
    dtypes = (np.float32, np.float32, np.float32, np.bool_, np.bool_, np.float32, np.float32)
    return Episodes(*(np.array(column, dtype) for column, dtype in zip(zip(*steps, strict=True), dtypes, strict=True)))


def main(argv: list[str] | None = None) -> int:
    """Run `ada-collect`; returns the exit status (2 for arguments that make no sense)."""
    parser = _parser()
    args = parser.parse_args(argv)
    try:
        job, recipe = _plan(args)
        expert = _expert(args, recipe)
        episodes, failures = collect(job, expert, _bar(args.quiet))
    except (ValueError, TypeError, OSError) as error:
        print(f"ada-collect: {error}", file=sys.stderr)
        return 2
    digest = save_episodes(episodes, args.out)
    command = shlex.join(["ada-collect", *(sys.argv[1:] if argv is None else argv)])
    card = _card(job, expert, episodes, {"failures": failures, "sha256": digest, "command": command, "path": args.out})
    save_card(card, args.out)
    print(json.dumps(card, indent=2) if args.json else _summary(card, args.out))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "ada-collect", description=DESCRIPTION, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", required=True, metavar="NAME", help=f"{', '.join(environments.NAMES)}, or a Gymnasium id")
    parser.add_argument("--out", required=True, type=Path, metavar="X.h5", help="the file to write; its folder is made")
    parser.add_argument("--episodes", type=int, default=300, metavar="N", help="episodes of 200 steps (default 300)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of everything random here (default 0)")
    parser.add_argument(
        "--option", action="append", default=[], metavar="KEY=VALUE", help="option of the environment, value as JSON; repeatable"
    )
    parser.add_argument(
        "--action-noise", metavar="A,B,..", help="standard deviations; each episode draws one (point 0.1,0.2,0.3; cheetah 0,0.05,0.1)"
    )
    expert = parser.add_argument_group("expert")
    expert.add_argument("--expert", type=Path, metavar="X.npz", help="fly this one instead of training one")
    expert.add_argument("--expert-seed", type=int, default=0, metavar="N", help="of the searches (default 0)")
    expert.add_argument("--expert-searches", type=int, default=3, metavar="N", help="searches for each policy (default 3)")
    expert.add_argument("--expert-iterations", type=int, default=250, metavar="N", help="updates in a search (default 250)")
    parser.add_argument("--json", action="store_true", help="print the data card instead of a summary")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    return parser


def _plan(args: argparse.Namespace) -> tuple[Job, ExpertRecipe | None]:
    """Check the arguments; raises `ValueError` naming the one that is wrong."""
    for flag, least in (("episodes", 1), ("seed", 0), ("expert_seed", 0), ("expert_searches", 1), ("expert_iterations", 1)):
        if getattr(args, flag) < least:
            raise ValueError(f"--{flag.replace('_', '-')} must be at least {least}")
    if args.out.suffix not in (".h5", ".hdf5"):
        raise ValueError(f"--out must end in .h5 or .hdf5, not {args.out.name!r}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    options = dict(_option(text) for text in args.option)
    env = environments.make(args.env, **options)
    is_point = isinstance(env.unwrapped, environments.PointWindS)
    noise = _noise(args.action_noise) if args.action_noise else (NOISE_POINT if is_point else NOISE_CHEETAH)
    ars = ArsSettings(iterations=args.expert_iterations)
    recipe = None if args.expert else recipe_for(env, options, args.expert_seed, args.expert_searches, ars)
    return Job(env.spec.id, options, args.episodes, noise, args.seed), recipe


def _option(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not key or not equals:
        raise ValueError(f"--option must be KEY=VALUE, not {text!r}")
    try:
        return key, json.loads(value)
    except json.JSONDecodeError:
        return key, value


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
    with tqdm(desc="expert searches", unit="search", disable=args.quiet, file=sys.stderr) as bar:

        def show(done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.refresh()

        expert = make_expert(recipe, show)
    save_expert(expert, cache)
    return expert


def _bar(quiet: bool) -> Callable[[range], Iterator[int]]:
    return lambda episodes: tqdm(episodes, desc="episodes", unit="episode", disable=quiet, file=sys.stderr)


def _card(job: Job, expert: Expert, episodes: Episodes, facts: dict[str, Any]) -> dict[str, Any]:
    returns = episodes.returns()
    return {
        "format": "d4rl-hdf5",
        "environment": {"id": job.env, "options": job.options},
        "episodes": len(returns),
        "steps": len(episodes.rewards),
        "seed": job.seed,
        "action_noise": list(job.noise),
        "returns": {
            "mean": round(float(returns.mean()), 3),
            "standard_error": round(float(returns.std(ddof=1) / np.sqrt(len(returns))), 3) if len(returns) > 1 else None,
            "median": round(float(np.median(returns)), 3),
            "min": round(float(returns.min()), 3),
            "max": round(float(returns.max()), 3),
            "failures": facts["failures"],
        },
        "expert": expert.card,
        "file": {"name": facts["path"].name, "bytes": facts["path"].stat().st_size, "sha256": facts["sha256"]},
        "command": facts["command"],
        "versions": {name: version(name) for name in ("ada-diffuser", "gymnasium", "h5py", "mujoco", "numpy")},
    }


def _summary(card: dict[str, Any], path: Path) -> str:
    returns = card["returns"]
    error = "" if returns["standard_error"] is None else f" +- {returns['standard_error']:.2f}"
    return (
        f"{path}: {card['episodes']} episodes, {card['steps']} steps; "
        f"return {returns['mean']:.2f}{error}, median {returns['median']:.2f}, {returns['failures']} failed\n"
        f"card: {card_path(path)}"
    )


if __name__ == "__main__":
    sys.exit(main())
