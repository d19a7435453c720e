"""What the experts of every environment earn that see the context, and those that do not: `python -m tests.worlds`.

Experts are formulas, or searched for as `ada-collect` does and kept where it keeps them: data/NAME.expert.npz, data/NAME.blind.npz.
Episode e of each is reset with seed 1000 + e and flown without action noise, as `ada-evaluate --seed 1000` has it. The rows go to
docs/worlds.json, in the place of those of the same environments, and as a table to the terminal.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from ada_diffuser import environments
from ada_diffuser.dataset import returns_summary
from ada_diffuser.experts import Expert, formula_of, kept_expert, load_expert, recipe_for

ROOT = Path(__file__).resolve().parent.parent
SEED = 1000


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.worlds", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="which environments (default: all)")
    parser.add_argument("--only", choices=("aware", "blind"), help="only these experts")
    parser.add_argument("--episodes", type=int, default=64, metavar="N", help="of each expert (default 64)")
    parser.add_argument("--experts", type=Path, default=ROOT / "data", metavar="FOLDER", help="where experts are kept (default data)")
    parser.add_argument("--as-kept", action="store_true", help="take what is kept there, whatever its settings were")
    parser.add_argument("--searches", type=int, metavar="N", help="for each policy (default: as the environment's class says)")
    parser.add_argument("--iterations", type=int, metavar="N", help="of a search (default: as the environment's class says)")
    parser.add_argument("--json", type=Path, default=ROOT / "docs/worlds.json", metavar="FILE", help="(default docs/worlds.json)")
    flags = parser.parse_args()
    for name in flags.names or environments.hidden():
        for kind in [flags.only] if flags.only else ("aware", "blind"):
            row = measured(name, expert_of(name, flags, blind=kind == "blind"), flags.episodes) | {"expert": kind}
            write([row], flags.json)
            print(line(row), flush=True)


def expert_of(name: str, flags: argparse.Namespace, *, blind: bool) -> Expert:
    env, kept = environments.make(name), flags.experts / f"{name}.{'blind' if blind else 'expert'}.npz"
    if formula := formula_of(env, blind=blind):
        return formula
    if flags.as_kept and kept.exists():
        return load_expert(kept)
    return kept_expert(recipe_for(env, {}, 0, flags.searches, flags.iterations, blind=blind), kept)


def measured(name: str, expert: Expert, episodes: int) -> dict[str, Any]:
    """One row: the returns of `episodes` episodes, and how the expert was made."""
    env = environments.make(name)
    flown = [_return(env, expert, SEED + episode) for episode in range(episodes)]
    summary = returns_summary(*(np.array(column) for column in zip(*flown, strict=True)))
    recipe = expert.card.get("recipe")
    how = {"for": recipe["env"], "searches": recipe["seeds"], "iterations": recipe["ars"]["iterations"]} if recipe else None
    return {"environment": name, "expert": "", "episodes": episodes, **summary, "search": how}


def _return(env: gym.Env, expert: Expert, seed: int) -> tuple[float, bool]:
    """What one episode earns, and whether it failed."""
    observation, _ = env.reset(seed=seed)
    total, ended = 0.0, False
    low, high = env.action_space.low, env.action_space.high
    while not ended:
        action = np.clip(expert.act(observation, env.unwrapped.context), low, high).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, ended = total + float(reward), terminated or truncated
    return total, environments.failed(env, total)


def write(rows: list[dict[str, Any]], path: Path) -> None:
    """Into the file, in the place of older rows of the same, in the order in which environments are listed."""
    kept = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    found = {(row["environment"], row["expert"]): row for row in [*kept, *rows]}
    order = [(name, expert) for name in environments.NAMES for expert in ("aware", "blind")]
    lines = [json.dumps(found[key]) for key in order if key in found]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("[\n  " + ",\n  ".join(lines) + "\n]\n", encoding="utf-8")


def line(row: dict[str, Any]) -> str:
    """A row of the table in clients/python/README.md."""
    earns = f"{row['mean']:.1f} ± {row['standard_error']:.1f}"
    return f"| `{row['environment']}` | {row['expert']} | {earns} | {row['failures']} of {row['episodes']} |"


if __name__ == "__main__":
    main()
