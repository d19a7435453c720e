"""Which sampling defaults a checkpoint should have: a grid of settings on validation episodes, and a rule that chooses.

`commands.choose.RULE` is the rule in words, `decide` is the rule, and `race` spares it the settings that have no chance.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ada_diffuser.options import SamplerOptions, several, word
from ada_diffuser.rollout.result import Evaluation

#: Values tried where nothing else is said; the checkpoint's own join them.
GRID = {
    "streaming": ["false", "true"],
    "kappa": ["0", "0.1"],
    "temperature": ["0", "0.25"],
    "latent_jump": ["0.3", "0.6", "1", "2"],
    "cold_distance": ["0.75", "1.5"],
}
#: Settings of a checkpoint alone: when a streaming window is not trusted any more. A session cannot choose them.
RESTART = ("renoise_distance", "cold_distance", "latent_jump", "latent_kl")
#: Fewer evaluations an act than this are no difference.
EVALUATIONS_ALIKE = 0.1
#: A setting is run no further when it is so many standard errors below the best cold one.
DROPPED_BELOW = 2.0
#: Nothing is dropped after fewer episodes.
EPISODES_TO_DROP = 8


@dataclass(frozen=True)
class Setting:
    """Sampling options, and what of `[restart]` goes with them."""

    options: SamplerOptions
    #: Names and values, none of a setting that does not stream: they would change nothing.
    restart: tuple[tuple[str, float], ...] = ()

    @classmethod
    def parse(cls, words: Mapping[str, str]) -> Setting:
        """From text; ValueError names the wrong one."""
        options = SamplerOptions.parse({name: word for name, word in words.items() if name not in RESTART})
        restart = tuple((name, _distance(name, words[name])) for name in RESTART if name in words)
        return cls(options, restart if options.streaming is not False else ())

    def values(self) -> dict[str, Any]:
        """By name, as a table or JSON has them."""
        return {**self.options.given(), **dict(self.restart)}

    def label(self) -> str:
        """In a line of a log."""
        return " ".join(f"{name}={word(value)}" for name, value in self.values().items())

    def overrides(self) -> list[str]:
        """As `ada-trainer defaults --set` takes them: `sampler.kappa=0.1`."""
        sections = [("sampler", self.options.given()), ("restart", dict(self.restart))]
        return [f"{section}.{name}={word(value)}" for section, values in sections for name, value in values.items()]


@dataclass(frozen=True)
class Facts:
    """What a checkpoint is, so far as the grid depends on it."""

    #: Its own value of each setting, as text.
    own: dict[str, str]
    #: Whether it can stream, has a latent, and may refine it.
    streams: bool
    latent: bool
    refined: bool

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Facts:
        """From the config of `ada-trainer inspect --json`, where infinity is null."""
        defaults, method = config["defaults"], config["method"]
        # Null is infinity, and what is not named is off.
        own = dict.fromkeys(RESTART) | defaults["sampler"] | defaults["restart"]
        return cls(
            {name: word(float("inf") if value is None else value) for name, value in own.items()},
            method["plan"]["schedule"]["kind"] == "ladder",
            method["latent"]["kind"] != "none",
            config["trained"]["refined"],
        )


def grid(words: Mapping[str, str], facts: Facts) -> list[Setting]:
    """Every choice of one value each, cold ones first; `words` (`{"kappa": "0,0.1"}`) take the place of `GRID`'s values.

    ValueError for a wrong one, and where there is none to compare with.
    """
    choices = {name: _sensible(name, [*values, facts.own[name]], facts) for name, values in GRID.items()}
    choices |= {name: several(values) for name, values in words.items()}
    choices["streaming"] = [value.lower() for value in choices["streaming"]]
    if "false" not in choices["streaming"]:
        raise ValueError("cold is the reference: false must be among the values of streaming")
    if len(choices.get("action_horizon", [])) > 1:
        raise ValueError("chunks of different lengths spend different evaluations an act: choose for one action_horizon at a time")
    choices["streaming"].sort()  # false first, as the table shows them
    return list(dict.fromkeys(Setting.parse(dict(zip(choices, choice, strict=True))) for choice in itertools.product(*choices.values())))


def _sensible(name: str, values: list[str], facts: Facts) -> list[str]:
    """The values that this checkpoint may take and that change something, each once."""
    if name == "streaming" and not facts.streams:
        return ["false"]
    if name in ("kappa", "latent_jump") and not facts.latent:
        return [facts.own[name]]
    if name == "kappa" and not facts.refined:
        return ["0"]
    return list({_number(value): value for value in values}.values())


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _distance(name: str, text: str) -> float:
    value = _number(text)
    if isinstance(value, str) or not value >= 0:
        raise ValueError(f"option {name}: {text!r} is not a number of at least 0, or inf")
    return value


@dataclass(frozen=True, eq=False)
class Gap:
    """How far a setting is below another one, on the same episodes."""

    mean: float
    #: Standard error of the mean, from each episode's difference.
    error: float

    @classmethod
    def between(cls, below: Evaluation, above: Evaluation) -> Gap:
        """On the episodes that `below` has, which may be fewer."""
        differences = above.returns[: len(below.episodes)] - below.returns
        return cls(float(differences.mean()), float(differences.std(ddof=1) / np.sqrt(len(differences))))


@dataclass(frozen=True, eq=False)
class Tried:
    """A setting and what it earned."""

    setting: Setting
    result: Evaluation

    @property
    def cold(self) -> bool:
        return self.result.options.streaming is False

    @property
    def episodes(self) -> int:
        return len(self.result.episodes)

    @property
    def evaluations(self) -> float:
        """Of an act."""
        return self.result.evaluations_per_act


#: Runs so many episodes more of a setting, the first of them with the offset: `play(setting, offset, episodes)`.
Play = Callable[[Setting, int, int], Evaluation]


def screened_on(episodes: int) -> int:
    """Episodes after which settings without a chance are dropped: a quarter, or all where that could tell nothing."""
    return episodes // 4 if episodes // 4 >= EPISODES_TO_DROP else episodes


def race(settings: Sequence[Setting], episodes: int, play: Play) -> list[Tried]:
    """Each setting on as many episodes as the rule needs of it, in the order of `settings`.

    The cold ones first: the best of them on all episodes, and those that a quarter does not show to be worse. Then a quarter with
    each of the others, and all episodes with those that are not clearly worse, the cheapest first, until one qualifies that none of the
    rest is cheaper than.
    """
    if episodes < 2:
        raise ValueError("a choice needs at least 2 episodes")
    tried: dict[Setting, Tried] = {}

    def run(setting: Setting, end: int) -> Tried:
        before = tried.get(setting)
        if before is None:
            tried[setting] = Tried(setting, play(setting, 0, end))
        elif before.episodes < end:
            tried[setting] = Tried(setting, before.result.joined(play(setting, before.episodes, end - before.episodes)))
        return tried[setting]

    first = screened_on(episodes)
    cold = [run(setting, first) for setting in settings if setting.options.streaming is False]
    best = _best_cold(cold)
    reference = _best_cold([run(one.setting, episodes) for one in cold if not _hopeless(one, best)])
    others = [run(setting, first) for setting in settings if setting.options.streaming is not False]
    fewest = reference.evaluations
    for one in sorted((one for one in others if not _hopeless(one, reference)), key=lambda one: one.evaluations):
        if one.evaluations > fewest + EVALUATIONS_ALIKE:
            break
        whole = run(one.setting, episodes)
        if _verdict(whole, reference) == "qualifies":
            fewest = min(fewest, whole.evaluations)
    return [tried[setting] for setting in settings]


def _best_cold(tried: Sequence[Tried]) -> Tried:
    """The first of the best."""
    return max((one for one in tried if one.cold), key=lambda one: one.result.mean_return)


def _hopeless(one: Tried, reference: Tried) -> bool:
    gap = Gap.between(one.result, reference.result)
    return gap.mean > DROPPED_BELOW * gap.error


@dataclass(frozen=True, eq=False)
class Choice:
    """What was chosen, and from what."""

    tried: list[Tried]
    reference: Tried
    chosen: Tried

    @property
    def qualified(self) -> list[Tried]:
        return [one for one in self.tried if self.verdict(one) in ("chosen", "reference", "qualifies")]

    def gap(self, one: Tried) -> Gap:
        """How far below the reference, on the episodes that it was run on."""
        return Gap.between(one.result, self.reference.result)

    def verdict(self, one: Tried) -> str:
        """One word or two on a setting."""
        if one is self.chosen:
            return "chosen"
        return "reference" if one is self.reference else _verdict(one, self.reference)

    def reason(self) -> str:
        """The choice in a sentence."""
        reference = self.reference.result
        best = f"{reference.mean_return:.2f} at {reference.evaluations_per_act:.2f} evaluations an act, {reference.failures} lost"
        rivals = f"{len(self.qualified)} of {len(self.tried)} settings qualify"
        if self.chosen is self.reference:
            others = (
                "none of the others needs fewer evaluations" if len(self.qualified) > 1 else "no other is within one standard error of it"
            )
            return f"cold's best ({best}) is chosen: {rivals}, and {others} without losing more episodes."
        gap, result = self.gap(self.chosen), self.chosen.result
        side = f"{abs(gap.mean):.2f} {'below' if gap.mean > 0 else 'above'}"
        return (
            f"{result.mean_return:.2f} is {side} cold's best ({best}), where one standard error of the difference is {gap.error:.2f}, and "
            f"{result.failures} lost; {rivals}, and at {result.evaluations_per_act:.2f} evaluations an act it is the best of the cheapest."
        )


def decide(tried: Sequence[Tried]) -> Choice:
    """The rule."""
    episodes = max(one.episodes for one in tried)
    finalists = [one for one in tried if one.episodes == episodes]
    reference = _best_cold(finalists)
    good = [one for one in finalists if one is reference or _verdict(one, reference) == "qualifies"]
    fewest = min(one.evaluations for one in good)
    cheap = [one for one in good if one.evaluations <= fewest + EVALUATIONS_ALIKE]
    return Choice(list(tried), reference, max(cheap, key=lambda one: one.result.mean_return))


def _verdict(one: Tried, reference: Tried) -> str:
    if one.episodes < reference.episodes:
        return "far below" if _hopeless(one, reference) else "dearer"
    gap = Gap.between(one.result, reference.result)
    if gap.mean > gap.error:
        return "below"
    return "qualifies" if one.result.failures <= reference.result.failures else "loses more"
