"""`ada-evaluate --choose`: sampling defaults for a checkpoint, chosen on validation episodes by a rule."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ada_diffuser.client import Client
from ada_diffuser.commands import check_environment, environment_options, parse_settings, warm_start
from ada_diffuser.commands.outputs import check_output, save_json
from ada_diffuser.commands.programs import Programs, defaults_line
from ada_diffuser.commands.progress import progress
from ada_diffuser.commands.variants import served

if TYPE_CHECKING:
    from ada_diffuser.rollout import Evaluation
    from ada_diffuser.rollout.choice import Choice, Facts, Setting, Tried
    from ada_diffuser.rollout.warm_start import WarmStart

#: Validation episodes: nothing is reported on them. The tables of models/README.md are of seeds from 1000 on.
FIRST_SEED = 5000

RULE = """\
Cold is the reference: of the settings that start every act from noise, the one with the highest mean return. Another setting qualifies
where its mean is not below that by more than one standard error of the difference, episode by episode (all see the same
ones), and it lost no more episodes. Of those that qualify, the reference among them, the one with the fewest evaluations an act is
chosen; a tenth of an evaluation is no difference, and then the higher mean decides."""


def run(arguments: argparse.Namespace) -> None:
    """Grid, race, rule; then the table, the choice, and what writes it."""
    _check(arguments)
    from ada_diffuser.rollout.choice import Facts, decide, grid, race
    from ada_diffuser.rollout.report import choice_table

    programs, begins_with = Programs.find(arguments.programs), warm_start(arguments)
    inspected = programs.inspect(arguments.choose)
    facts = Facts.of(inspected["config"])
    settings = grid(parse_settings(arguments.set), facts)
    variants = list(dict.fromkeys(_restart(setting, facts) for setting in settings))
    with served(programs, arguments.choose, variants) as client:
        runner = _Runner(arguments, client, {setting: str(variants.index(_restart(setting, facts))) for setting in settings}, begins_with)
        runner.check()
        choice = decide(race(settings, arguments.episodes, runner.play))
    keys, out = choice.chosen.setting.overrides(), arguments.write or Path(f"{arguments.choose}-chosen")
    line = defaults_line(arguments.choose, out, keys)
    if arguments.json:
        save_json(_as_json(arguments, inspected["digest"], choice, line), arguments.json)
    print(choice_table(choice))
    print(f"\nchosen: {' '.join(keys)}\n{choice.reason()}\n{line}", flush=True)
    if arguments.write:
        programs.defaults(arguments.choose, out, keys)
        print(f"written: {out}")


def _check(arguments: argparse.Namespace) -> None:
    """What can be known before anything is run."""
    checkpoint, out = arguments.choose, arguments.write
    check_output("--json", arguments.json)
    if arguments.models:
        raise ValueError("--choose takes a checkpoint's directory, and no --models")
    if out and out.exists() and not out.is_dir():
        raise ValueError(f"--write {out} is a file, and a directory is to be written")
    if out and out.resolve() == checkpoint.resolve() and (out / "training").exists():
        raise ValueError(f"--write {out}: the next `run` would write the recipe's defaults again; name another directory")
    check_environment(arguments)


def _restart(setting: Setting, facts: Facts) -> tuple[str, ...]:
    """All keys of `[restart]`, those that the setting leaves open as the checkpoint has them."""
    from ada_diffuser.rollout.choice import RESTART, word

    given = dict(setting.restart)
    return tuple(f"restart.{name}={word(given[name]) if name in given else facts.own[name]}" for name in RESTART)


class _Runner:
    """Plays settings through the server, and says so."""

    def __init__(self, arguments: argparse.Namespace, client: Client, models: Mapping[Setting, str], begins_with: WarmStart | None) -> None:
        self.arguments, self.client, self.models, self.begins_with = arguments, client, models, begins_with
        self.steps_max = 0

    def check(self) -> None:
        """That every setting is taken, before the first episode."""
        from ada_diffuser.rollout import check

        for setting in self.models:
            self.steps_max = check(self.client, self._trial(setting, 0, 1))

    def play(self, setting: Setting, offset: int, episodes: int) -> Evaluation:
        from ada_diffuser.rollout import evaluate
        from ada_diffuser.rollout.report import outcome

        title = setting.label()
        with progress(episodes * self.steps_max, title, "step") as advance:
            result = evaluate(self.client, self._trial(setting, offset, episodes), advance)
        if not self.arguments.markdown:
            print(f"episodes {offset} to {offset + episodes - 1}: {title} {outcome(result)}", file=sys.stderr, flush=True)
        return result

    def _trial(self, setting: Setting, offset: int, episodes: int) -> Any:
        from ada_diffuser.rollout import Trial

        asked = self.arguments
        return Trial(
            asked.env,
            self.models[setting],
            episodes,
            asked.seed + offset,
            asked.vector,
            setting.options,
            asked.episode_steps,
            withhold_rewards=asked.withhold_rewards,
            env_options=environment_options(asked.env_option),
            warm_start=self.begins_with,
        )


def _as_json(arguments: argparse.Namespace, digest: str, choice: Choice, line: str) -> dict[str, Any]:
    """The choice with everything that it was made from."""
    from ada_diffuser.rollout.result import plain_options

    def of(one: Tried) -> dict[str, Any]:
        told = one.result.as_json()
        gap = choice.gap(one)
        kept = {
            name: value
            for name, value in told.items()
            if name not in ("env", "env_options", "model", "model_digest", "vector", "withhold_rewards")
        }
        return {
            "setting": plain_options(one.setting.values()),
            "verdict": choice.verdict(one),
            "episodes": one.episodes,
            "below_reference": round(gap.mean, 6),
            "below_reference_standard_error": round(gap.error, 6),
            **kept,
        }

    return {
        "env": arguments.env,
        **choice.reference.result.trial.env_options_as_json(),
        "checkpoint": str(arguments.choose),
        "checkpoint_digest": digest,
        "seed": arguments.seed,
        "episodes": arguments.episodes,
        "withhold_rewards": arguments.withhold_rewards,
        "rule": " ".join(RULE.split()),
        "chosen": choice.chosen.setting.overrides(),
        "reference": choice.reference.setting.overrides(),
        "reason": choice.reason(),
        "command": line,
        "settings": [of(one) for one in choice.tried],
    }
