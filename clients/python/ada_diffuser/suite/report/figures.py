"""Pictures of a suite: a column of axes for each environment. Each draws what there is, and says False where that is nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ada_diffuser.rollout.plot import pyplot, save
from ada_diffuser.suite.report.results import Estimate, Group, Results, own_error, probe_error
from ada_diffuser.suite.suite import Method, Mode

_MARKER: dict[Mode, str] = {"cold": "o", "streaming": "s"}
#: Pictures beside one another in a row.
_LATENTS_MAX = 6


def returns(results: Results, path: Path) -> bool:
    """A line for each method."""
    figure, axes = _columns(results.environments, 1.6 + 0.4 * len(results.methods))
    for ax, environment in zip(axes[0], results.environments, strict=True):
        there = [method for method in results.methods if results.any_mode(environment, method.name)]
        for row, method in enumerate(there):
            _draw_returns(ax, results, environment, method, -row)
        ax.set(title=environment, xlabel="return")
        ax.set_yticks([-row for row in range(len(there))], [method.name for method in there])
        ax.grid(axis="x", alpha=0.3)
    return _finish(figure, path)


def _draw_returns(ax: Any, results: Results, environment: str, method: Method, at: int) -> None:
    for n, mode in enumerate(results.modes):
        group = results.group(environment, method.name, mode)
        if group:
            value, y = group.estimate, at + 0.15 * (0.5 - n)
            error = value.over_seeds if value.over_seeds is not None else value.over_episodes
            ax.errorbar(value.mean, y, xerr=error, fmt=_MARKER[mode], color=f"C{n}", capsize=3, markersize=5, label=mode)
            ax.plot(group.returns.mean(axis=1), np.full(len(group.files), y), ".", color=f"C{n}", markersize=3, alpha=0.6)
    paper = results.suite.paper.get(environment, {}).get(method.name)
    if isinstance(paper, (int, float)):
        ax.plot(paper, at, "*", color="black", markersize=9, label="the paper's")


def probe(results: Results, path: Path) -> bool:
    """Error against the tokens that the latent is shown, up to all that it looks at."""
    lines = {
        (environment, method.name): line
        for environment in results.environments
        for method in results.methods
        if (group := results.any_mode(environment, method.name)) and (line := _by_block(group))
    }
    if not any(len(line) > 1 for line in lines.values()):
        return False
    environments = list(dict.fromkeys(environment for environment, _ in lines))
    figure, axes = _columns(environments, 4.2)
    for ax, environment in zip(axes[0], environments, strict=True):
        for n, method in enumerate(results.methods):
            line = lines.get((environment, method.name))
            if line:
                _errorbars(ax, list(line), [error for error, _ in line.values()], f"C{n}", method.name)
                ax.plot(list(line), [ceiling for _, ceiling in line.values()], "--", color=f"C{n}", alpha=0.5)
        ax.set(title=environment, xlabel="tokens shown", ylabel="error (0 knows all, 1 nothing)", ylim=(0, None))
    return _finish(figure, path)


def _by_block(group: Group) -> dict[int, tuple[Estimate, float]]:
    """By tokens shown: the probe's error over training seeds, and the ceiling there."""
    rows = [row for file in group.files for row in file["probe"] or [] if row["evidence"] == "filter" and row["mse"] is not None]
    lengths = sorted({row["block_len"] for row in rows if row["block_len"] is not None})
    at = {length: [row for row in rows if row["block_len"] == length] for length in lengths}
    return {
        length: (
            Estimate.of([row["mse"] for row in same]),
            float(np.mean([row["ceiling"] for row in same if row["ceiling"] is not None] or [np.nan])),
        )
        for length, same in at.items()
    }


def varied(results: Results, family: str, key: str, path: Path) -> bool:
    """Return, and the latent's error below it, by the value of one key."""
    variants = [one for one in results.methods if one.family == family and one.varied and one.varied[0] == key]
    environments = [name for name in results.environments if any(results.any_mode(name, one.name) for one in variants)]
    if not environments:
        return False
    figure, axes = _columns(environments, 3.4, rows=2)
    for (top, bottom), environment in zip(axes.T, environments, strict=True):
        for n, mode in enumerate(results.modes):
            groups = [(one, group) for one in variants if (group := results.group(environment, one.name, mode))]
            _draw_varied(top, [(one, group.estimate) for one, group in groups], variants, f"C{n}", mode)
            _draw_varied(bottom, [(one, group.each(own_error)) for one, group in groups], variants, f"C{n}", mode)
        held_out = [(one, group.each(probe_error)) for one in variants if (group := results.any_mode(environment, one.name))]
        _draw_varied(bottom, held_out, variants, "C2", "held-out data")
        top.set(title=environment, ylabel="return")
        bottom.set(xlabel=key, ylabel="error of the latent (0 knows all)")
        for ax in (top, bottom):
            ax.set_xticks(range(len(variants)), [str(one.varied[1]) for one in variants if one.varied])
    return _finish(figure, path)


def _draw_varied(ax: Any, values: Sequence[tuple[Method, Estimate | None]], variants: Sequence[Method], color: str, label: str) -> None:
    """At the place of each value, evenly spaced: they may be words, or infinite."""
    there = [(variants.index(one), value) for one, value in values if value is not None]
    if there:
        _errorbars(ax, [at for at, _ in there], [value for _, value in there], color, label)


def latents(results: Results, path: Path) -> bool:
    """A row for each environment, a column for each method that has a latent."""
    shown = {
        environment: [
            (method, file["latents"])
            for method in results.methods
            if (group := results.any_mode(environment, method.name))
            for file in group.files
            if file["latents"]
        ][:_LATENTS_MAX]
        for environment in results.environments
    }
    shown = {environment: ones for environment, ones in shown.items() if ones}
    if not shown:
        return False
    width = max(map(len, shown.values()))
    figure, axes = pyplot().subplots(len(shown), width, figsize=(4 * width, 3.4 * len(shown)), squeeze=False, layout="constrained")
    for row, (environment, ones) in zip(axes, shown.items(), strict=True):
        for ax in row[len(ones) :]:
            ax.set_axis_off()
        for ax, (method, told) in zip(row, ones, strict=False):
            x, y, context = np.array(told["points"]).T
            points = ax.scatter(x, y, c=context, s=8, cmap="viridis")
            ax.set_title(f"{environment}: {method.name}", fontsize=8)
            ax.set_xlabel(f"{100 * told['shares'][0]:.0f} % of the variance")
            ax.set_ylabel(f"{100 * told['shares'][1]:.0f} %")
            figure.colorbar(points, ax=ax, label="context")
    save(figure, path)
    return True


def plans(results: Results, path: Path) -> bool:
    """Above: the error by the step ahead. Below: plans of one episode of the reference, or of the first method that has any."""
    told = {
        (environment, method.name): found
        for environment in results.environments
        for method in results.methods
        if (group := results.any_mode(environment, method.name)) and (found := [file["plan"] for file in group.files if file["plan"]])
    }
    environments = list(dict.fromkeys(environment for environment, _ in told))
    if not environments:
        return False
    figure, axes = _columns(environments, 3.4, rows=2)
    for (top, bottom), environment in zip(axes.T, environments, strict=True):
        for n, method in enumerate(results.methods):
            if found := told.get((environment, method.name)):
                ahead = min((one["ahead"] for one in found), key=len)
                errors = [Estimate.of([one["error"][at] for one in found]) for at in range(len(ahead))]
                _errorbars(top, ahead, errors, f"C{n}", method.name)
        top.set(title=environment, xlabel="steps ahead", ylabel="squared error over variance", yscale="log")
        _draw_plans(bottom, results, environment)
    return _finish(figure, path)


def _draw_plans(ax: Any, results: Results, environment: str) -> None:
    names = sorted((method.name for method in results.methods), key=lambda name: name != results.suite.reference)
    groups = [(name, group) for name in names if (group := results.any_mode(environment, name))]
    told = [(name, file) for name, group in groups for file in group.files if file["plan"] and "plans" in file["plan"]]
    if not told:
        return ax.set_axis_off()
    name, file = told[0]
    plan = file["plan"]
    ax.plot(plan["states"], color="black", label="what happened (below)")
    for one in plan["plans"]:
        steps = one["step"] + np.arange(len(one["states"]))
        ax.plot(steps, one["states"], ".-", color="C3", markersize=3, linewidth=0.8, label="plans (below)")
    ax.set(title=f"{name}, {file['mode']}, training seed {file['seed']}", xlabel="step", ylabel=f"state column {plan['column']}")


def cost(results: Results, path: Path) -> bool:
    """Return against evaluations an act."""
    figure, axes = _columns(results.environments, 4.6)
    for ax, environment in zip(axes[0], results.environments, strict=True):
        for n, method in enumerate(results.methods):
            for mode in results.modes:
                group = results.group(environment, method.name, mode)
                spent = group and group.each(lambda file: file["evaluations_per_act"])
                if group and spent:
                    value = group.estimate
                    label = f"{method.name}, {mode}"
                    ax.errorbar(spent.mean, value.mean, yerr=value.over_seeds, fmt=_MARKER[mode], color=f"C{n}", capsize=3, label=label)
        ax.set(title=environment, xlabel="evaluations an act", ylabel="return")
        ax.set_xscale("log", base=2)
        ax.xaxis.set_major_formatter("{x:g}")
    return _finish(figure, path)


def _errorbars(ax: Any, x: Sequence[Any], values: Sequence[Estimate], color: str, label: str) -> None:
    errors = [0.0 if value.over_seeds is None else value.over_seeds for value in values]
    ax.errorbar(x, [value.mean for value in values], yerr=errors, fmt=".-", color=color, capsize=3, label=label)


def _columns(environments: Sequence[str], height: float, rows: int = 1) -> tuple[Any, Any]:
    """Axes `(rows, environments)`."""
    count = len(environments)
    figure, axes = pyplot().subplots(rows, count, figsize=(max(7.0, 5.0 * count), height * rows), squeeze=False, layout="constrained")
    return figure, axes


def _finish(figure: Any, path: Path) -> bool:
    """Writes it with one legend for all axes, each label once."""
    handles = {label: handle for ax in figure.axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=min(3, len(handles)), fontsize=8)
    save(figure, path)
    return True
