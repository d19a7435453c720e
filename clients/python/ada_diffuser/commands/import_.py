"""`ada-import`: a data set of D4RL, Minari or robomimic, as it is, in the layout that the trainer reads."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ada_diffuser.commands import run_command
from ada_diffuser.commands.outputs import check_output
from ada_diffuser.commands.progress import progress

_ABOUT = """\
Take a data set of D4RL, Minari or robomimic as it is, and write its episodes as the D4RL-layout HDF5 file that ada-trainer reads:
observations, actions, rewards, terminals, timeouts, and infos/context where there is one; one row a step, 32-bit floats. Beside it goes
X.card.json: where it came from, its SHA-256, returns, and which columns of the observation are what.

SOURCE is a file, a folder, or the id of a Minari data set on this machine (MINARI_DATASETS_PATH, else ~/.minari/datasets).

  d4rl       flat arrays at the root. Episodes end at `terminals` and `timeouts`; the oldest files have no `timeouts`, and then
             --episode-steps N says after how many steps the clock ended an episode. `next_observations` are not needed, but held against
             the rows: where they disagree, episodes are glued together, and the card says where.
  minari     read by the library minari. An episode has one observation more than actions; the last one is left out.
  robomimic  (LIBERO too) a group for each demonstration; --filter KEY takes those of mask/KEY.

An episode of Minari and a demonstration of robomimic end at their last step and nowhere else: as terminal, if it says so, else as timeout.

The agent sees one vector. Where the observations are several parts, as in mazes and in robomimic, --observation KEY,KEY joins those that
you name, in that order; without it the error lists them. The names are as the source has them, below `observations` or `obs`; infos/... may
be named too. Images and whole numbers are refused by name.

--context KEY,KEY is the hidden truth instead: latents are judged by it (ada-trainer probe) and oracles told it, but no other model sees it.
infos/context is taken for it without a word.

Anything that nothing can be trained on is an error that names the array and the row: what is missing, of another length or width than
elsewhere, not a number, not finite. Then nothing is written, and the exit status is 1."""

_EXAMPLES = """\
examples:
  ada-import halfcheetah_medium-v2.hdf5 --out data/halfcheetah.h5
  ada-import hopper_mixed.hdf5 --episode-steps 1000 --out data/hopper.h5
  ada-import maze2d-umaze-sparse-v1.hdf5 --observation observations,infos/goal --out data/umaze.h5
  ada-import D4RL/pointmaze/umaze-v2 --observation observation,desired_goal --out data/pointmaze.h5
  ada-import low_dim_v141.hdf5 --filter train --observation robot0_eef_pos,robot0_eef_quat,robot0_gripper_qpos,object --out data/lift.h5
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; 0; 1 with a line on stderr that names what is wrong; 130 when interrupted. No data set is written then."""
    args = _parser().parse_args(argv)
    command = shlex.join(["ada-import", *(sys.argv[1:] if argv is None else argv)])
    return run_command("ada-import", lambda: _run(args, command), extra="import")


def _run(args: argparse.Namespace, command: str) -> None:
    """Source, files, and the card or what matters of it."""
    if args.episode_steps is not None and args.episode_steps < 1:
        raise ValueError("--episode-steps must be at least 1")
    check_output("--out", args.out, ".h5", ".hdf5")
    from ada_diffuser.importing import Request, import_data

    request = Request(
        source=args.source,
        format=args.format,
        observation=_names("--observation", args.observation),
        context=_names("--context", args.context),
        filter=args.filter,
        episode_steps=args.episode_steps,
        zero_rewards=args.reward == "zero",
    )
    card = import_data(request, args.out, command, lambda steps: progress(steps, "import", "step", quiet=args.quiet))
    print(json.dumps(card, indent=2) if args.json else _summary(card, args.out))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "ada-import", description=_ABOUT, epilog=_EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", metavar="SOURCE", help="a file, a folder, or the id of a Minari data set")
    parser.add_argument("--out", required=True, type=Path, metavar="X.h5", help="the file to write; its folder is made")
    parser.add_argument("--format", choices=("d4rl", "minari", "robomimic"), help="(default: as the source shows)")
    parser.add_argument("--observation", metavar="KEY,..", help="what the agent sees, joined in this order")
    parser.add_argument("--context", metavar="KEY,..", help="the hidden truth, joined in this order (default: infos/context)")
    parser.add_argument("--filter", metavar="KEY", help="the demonstrations of this mask of a robomimic file (default: all)")
    parser.add_argument("--episode-steps", type=int, metavar="N", help="where the clock ended episodes, for a D4RL file without timeouts")
    parser.add_argument("--reward", choices=("zero",), help="write zeros for rewards, as for a source that has none")
    parser.add_argument("--json", action="store_true", help="print the data card instead of a summary")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    return parser


def _names(flag: str, text: str | None) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",")) if text is not None else ()
    if text is not None and not all(names):
        raise ValueError(f"{flag} must be names with commas between, not {text!r}")
    return names


def _summary(card: dict[str, Any], path: Path) -> str:
    from ada_diffuser.dataset import card_path

    returns, lengths = card["returns"], card["lengths"]
    error = "" if returns["standard_error"] is None else f" +- {returns['standard_error']:.2f}"
    length = f"{lengths['min']} to {lengths['max']}" if lengths["min"] < lengths["max"] else str(lengths["max"])
    lines = [
        f"{path}: {card['episodes']} episodes of {length} steps, {card['steps']} steps; "
        f"return {returns['mean']:.2f}{error}, median {returns['median']:.2f}",
        *(f"{word}: {_parts(card[word])}" for word in ("observations", "actions", "context") if word in card),
        *(f"note: {note}" for note in card["notes"]),
        f"card: {card_path(path)}",
    ]
    return "\n".join(lines)


def _parts(parts: list[dict[str, Any]]) -> str:
    """`17`, or `object 14, robot0_eef_pos 3: 17`."""
    width = sum(part["width"] for part in parts)
    names = ", ".join(f"{part['name']} {part['width']}" for part in parts)
    return f"{names}: {width}" if len(parts) > 1 else str(width)


if __name__ == "__main__":
    sys.exit(main())
