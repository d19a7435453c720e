"""Tables: one trial for a terminal, many for Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from ada_diffuser.messages import SamplerOptions
from ada_diffuser.rollout.choice import Choice, Tried
from ada_diffuser.rollout.readout import Place, Reading, Readout
from ada_diffuser.rollout.result import Evaluation, Measure, mean_and_error
from ada_diffuser.rollout.seeds import SeedGroup, by_recipe

#: Options that do nothing at these values, and those that do nothing beside them.
_OFF: dict[str, tuple[object, ...]] = {
    "sub_steps": (1,),
    "eta": (0.0,),
    "latent": ("mean",),
    "guidance_scale": (0.0, "guidance_samples"),
    "free_guidance_scale": (1.0,),
    "candidates": (1, "pick_temperature"),
    "picard_window": (1, "picard_tolerance"),
}
#: Where differences stand in the table.
_AFTER_MEDIAN = 6


def table(readings: Sequence[Reading]) -> str:
    """What the demo ends with: a column for each model, all on the same episodes."""
    rows = [(cells[0][0], *(value for _, value in cells)) for cells in zip(*map(_column, readings), strict=True)]
    if len(readings) > 1:
        first = readings[0].result
        rows.insert(_AFTER_MEDIAN, ("above the first", "", *(_difference(one.result, first) for one in readings[1:])))
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)


def _column(reading: Reading) -> list[tuple[str, str]]:
    result, readout = reading.result, reading.readout
    options = ", ".join(f"{name}={_setting(value)}" for name, value in _told(result.options).items())
    call = "batch" if result.trial.vector > 1 else "act"
    return [
        ("environment", result.trial.env),
        ("model", f"{result.model.name}@{result.model.digest[:12]}"),
        ("options", options),
        ("episodes", f"{len(result.episodes)}, seeds from {result.trial.seed}, {min(result.trial.vector, len(result.episodes))} at a time"),
        ("mean return", f"{result.mean_return:.2f} ± {result.standard_error:.2f}"),
        ("median return", f"{result.median_return:.2f}"),
        ("failures", f"{result.failures} of {len(result.episodes)}"),
        *((name, measured(one)) for name, one in result.measures.items()),
        (f"latency of {call}", f"p50 {result.latency_ms(50):.2f} ms, p99 {result.latency_ms(99):.2f} ms"),
        *((f"  server, {part}", _server_row(result, part)) for part in ("queue", "compute", "commit", "total")),
        ("evaluations an act", f"{result.evaluations_per_act:.2f}"),
        ("acts", f"{result.acts.acts}, {result.acts.replayed} replayed"),
        ("context readout", f"R² {readout.r2:.3f}" if isinstance(readout, Readout) else readout),
        ("time", f"{result.wall_s:.1f} s"),
    ]


def _told(options: SamplerOptions) -> dict[str, object]:
    """Those in force that do something."""
    given = options.given()
    off = {name: others for name, (value, *others) in _OFF.items() if given.get(name) == value}
    silent = {*off, *(other for others in off.values() for other in others)}
    return {name: value for name, value in given.items() if name not in silent}


def _difference(result: Evaluation, other: Evaluation) -> str:
    """Of the mean returns, with the standard error over the episodes, which are the same."""
    mean, error = mean_and_error([result.returns[[i]] - other.returns[[i]] for i in range(len(result.returns))])
    return f"{mean:+.2f} ± {error:.2f}"


def outcome(result: Evaluation) -> str:
    """In a line of a log."""
    places = f", by episode {' '.join(f'{one.mean_return:.2f}' for one in result.by_index)}" if result.trial.session_episodes > 1 else ""
    measures = "".join(f", {name} {measured(one)}" for name, one in result.measures.items())
    return f"{result.mean_return:.2f} ± {result.standard_error:.2f}{places}{measures}, {result.failures} failed, {result.wall_s:.1f} s"


def measured(measure: Measure | None) -> str:
    """What an environment says beside the return; nothing where it does not."""
    return f"{measure.mean:.2f} ± {measure.standard_error:.2f}" if measure else ""


def _server_row(result: Evaluation, part: str) -> str:
    return f"p50 {result.server_ms(part, 50):.2f} ms, p99 {result.server_ms(part, 99):.2f} ms"


def markdown(results: Sequence[Evaluation], settings: Sequence[str]) -> str:
    """One row a trial; `settings` are the options that vary, each a column.

    Models that are training seeds of one recipe (`NAME-seed0`, `NAME-seed1`, ...) get one row more together, and then there is
    a column with the standard error over the training seeds beside that over the episodes.
    """
    groups = by_recipe(results)
    error = "± training seeds"
    measures = list(dict.fromkeys(name for result in results for name in result.measures))
    heads = ["environment", "model", *settings, "return", error, *measures, "median", "failures", "evaluations/act", "p50 ms", "p99 ms"]
    rows = [_trial_cells(result, settings, measures) for result in results]
    rows += [_group_cells(group, settings, measures) for group in groups]
    if not groups:
        _drop(error, heads, rows)
    return rows_of(heads, rows)


def _trial_cells(result: Evaluation, settings: Sequence[str], measures: Sequence[str]) -> list[str]:
    return [
        result.trial.env,
        result.model.name,
        *(_setting(getattr(result.options, name)) for name in settings),
        f"{result.mean_return:.2f} ± {result.standard_error:.2f}",
        "",
        *(measured(result.measures.get(name)) for name in measures),
        f"{result.median_return:.2f}",
        f"{result.failures}/{len(result.episodes)}",
        f"{result.evaluations_per_act:.2f}",
        f"{result.latency_ms(50):.1f}",
        f"{result.latency_ms(99):.1f}",
    ]


def _group_cells(group: SeedGroup, settings: Sequence[str], measures: Sequence[str]) -> list[str]:
    results = group.results
    return [
        results[0].trial.env,
        f"{group.recipe}, {len(results)} training seeds",
        *(_setting(getattr(results[0].options, name)) for name in settings),
        f"{group.mean_return:.2f} ± {group.standard_error:.2f}",
        f"± {group.standard_error_training:.2f}",
        *(measured(group.measures.get(name)) for name in measures),
        f"{group.median_return:.2f}",
        f"{group.failures}/{sum(len(result.episodes) for result in results)}",
        f"{fmean(result.evaluations_per_act for result in results):.2f}",
        "",
        "",
    ]


def session_table(results: Sequence[Evaluation], settings: Sequence[str]) -> str:
    """One row a trial in sessions: what the episodes earn by their place in the session; the errors are over sessions."""
    indices = range(max(len(result.by_index) for result in results))
    heads = ["environment", "model", *settings, "history", "sessions", *(f"episode {index}" for index in indices)]
    return rows_of(heads, [_session_cells(result, settings, indices) for result in results])


def _session_cells(result: Evaluation, settings: Sequence[str], indices: Sequence[int]) -> list[str]:
    by_index = {one.index: f"{one.mean_return:.2f} ± {one.standard_error:.2f}" for one in result.by_index}
    return [
        result.trial.env,
        result.model.name,
        *(_setting(getattr(result.options, name)) for name in settings),
        "forgotten" if result.trial.forget else "kept",
        str(len(result.trial.sessions)),
        *(by_index.get(index, "") for index in indices),
    ]


def choice_table(choice: Choice) -> str:
    """One row a setting, in Markdown: what it earned, and how far that is below the best cold one's, episode by episode."""
    names = list(dict.fromkeys(name for one in choice.tried for name in one.setting.values()))
    heads = [*names, "episodes", "return", "median", "failures", "evaluations/act", "below cold's best", "verdict"]
    return rows_of(heads, [_tried_cells(one, choice, names) for one in choice.tried])


def _tried_cells(one: Tried, choice: Choice, names: Sequence[str]) -> list[str]:
    result, gap, values, verdict = one.result, choice.gap(one), one.setting.values(), choice.verdict(one)
    return [
        *(_setting(values[name]) if name in values else "" for name in names),
        str(one.episodes),
        f"{result.mean_return:.2f} ± {result.standard_error:.2f}",
        f"{result.median_return:.2f}",
        f"{result.failures}/{one.episodes}",
        f"{result.evaluations_per_act:.2f}",
        "" if one is choice.reference else f"{gap.mean:.2f} ± {gap.error:.2f}",
        f"**{verdict}**" if one is choice.chosen else verdict,
    ]


def readout_table(readings: Sequence[Reading], settings: Sequence[str]) -> str:
    """What each latent says of the true context: the standardised squared error of a linear map from it, by age in the episode.

    Where episodes follow one another, the first ones and the later ones have a row each.
    """
    placed = [(one, place) for one in readings for place in one.places]
    ages = list(dict.fromkeys(error.age for one, place in placed for error in one.errors(place)))
    steps = [f"steps {first} to {last - 1}" for first, last in ages]
    heads = ["environment", "model", *settings, "latent", "episodes", *steps, "k-means: Rand index, purity"]
    rows = [_reading_cells(one, place, settings, ages) for one, place in placed]
    if all(place == "all" for _, place in placed):
        _drop("episodes", heads, rows)
    return rows_of(heads, rows)


def _reading_cells(one: Reading, place: Place, settings: Sequence[str], ages: Sequence[tuple[int, int]]) -> list[str]:
    by_age = {error.age: f"{error.mse:.3f} ± {error.standard_error:.3f}" for error in one.errors(place)}
    return [
        one.result.trial.env,
        one.result.model.name,
        *(_setting(getattr(one.result.options, name)) for name in settings),
        one.readout if isinstance(one.readout, str) else one.evidence,
        place,
        *(by_age.get(age, "") for age in ages),
        f"{one.clusters.adjusted_rand_index:.2f}, {one.clusters.purity:.2f}" if one.clusters else "",
    ]


def _drop(head: str, heads: list[str], rows: Sequence[list[str]]) -> None:
    """Leaves out a column that would say nothing."""
    at = heads.index(head)
    for row in [heads, *rows]:
        del row[at]


def rows_of(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    return "\n".join(["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads), *("| " + " | ".join(row) + " |" for row in rows)])


def _setting(value: object) -> str:
    if isinstance(value, tuple):
        return f"[{','.join(map(_setting, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value).lower()
