"""Tables: one trial for a terminal, many for Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

from ada_diffuser.rollout.readout import Readout
from ada_diffuser.rollout.result import Evaluation
from ada_diffuser.rollout.seeds import SeedGroup, by_recipe


def table(result: Evaluation, readout: Readout | str) -> str:
    """What the demo ends with."""
    options = ", ".join(f"{name}={_setting(value)}" for name, value in result.options.given().items())
    call = "batch" if result.trial.vector > 1 else "act"
    rows = [
        ("environment", result.trial.env),
        ("model", f"{result.model.name}@{result.model.digest[:12]}"),
        ("options", options),
        ("episodes", f"{len(result.episodes)}, seeds from {result.trial.seed}, {min(result.trial.vector, len(result.episodes))} at a time"),
        ("mean return", f"{result.mean_return:.2f} ± {result.standard_error:.2f}"),
        ("median return", f"{result.median_return:.2f}"),
        ("failures", f"{result.failures} of {len(result.episodes)}"),
        (f"latency of {call}", f"p50 {result.latency_ms(50):.2f} ms, p99 {result.latency_ms(99):.2f} ms"),
        *((f"  server, {part}", _server_row(result, part)) for part in ("queue", "compute", "commit", "total")),
        ("evaluations an act", f"{result.evaluations_per_act:.2f}"),
        ("acts", f"{result.acts.acts}, {result.acts.replayed} replayed"),
        ("context readout", f"R² {readout.r2:.3f}" if isinstance(readout, Readout) else readout),
        ("time", f"{result.wall_s:.1f} s"),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def _server_row(result: Evaluation, part: str) -> str:
    return f"p50 {result.server_ms(part, 50):.2f} ms, p99 {result.server_ms(part, 99):.2f} ms"


def markdown(results: Sequence[Evaluation], settings: Sequence[str]) -> str:
    """One row a trial; `settings` are the options that vary, each a column.

    Models that are training seeds of one recipe (`NAME-seed0`, `NAME-seed1`, ...) get one row more together, and then there is
    a column with the standard error over the training seeds beside that over the episodes.
    """
    groups = by_recipe(results)
    error = "± training seeds"
    heads = ["environment", "model", *settings, "return", error, "median", "failures", "evaluations/act", "p50 ms", "p99 ms"]
    rows = [_trial_cells(result, settings) for result in results] + [_group_cells(group, settings) for group in groups]
    if not groups:
        at = heads.index(error)
        for row in [heads, *rows]:
            del row[at]
    return "\n".join(["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads), *("| " + " | ".join(row) + " |" for row in rows)])


def _trial_cells(result: Evaluation, settings: Sequence[str]) -> list[str]:
    return [
        result.trial.env,
        result.model.name,
        *(_setting(getattr(result.options, name)) for name in settings),
        f"{result.mean_return:.2f} ± {result.standard_error:.2f}",
        "",
        f"{result.median_return:.2f}",
        f"{result.failures}/{len(result.episodes)}",
        f"{result.evaluations_per_act:.2f}",
        f"{result.latency_ms(50):.1f}",
        f"{result.latency_ms(99):.1f}",
    ]


def _group_cells(group: SeedGroup, settings: Sequence[str]) -> list[str]:
    results = group.results
    return [
        results[0].trial.env,
        f"{group.recipe}, {len(results)} training seeds",
        *(_setting(getattr(results[0].options, name)) for name in settings),
        f"{group.mean_return:.2f} ± {group.standard_error:.2f}",
        f"± {group.standard_error_training:.2f}",
        f"{group.median_return:.2f}",
        f"{group.failures}/{sum(len(result.episodes) for result in results)}",
        f"{fmean(result.evaluations_per_act for result in results):.2f}",
        "",
        "",
    ]


def _setting(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value).lower()
