"""The picture of a rollout: rewards and returns, and the true context beside the one read out of the latent."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from ada_diffuser import environments
from ada_diffuser.rollout.clusters import Clusters
from ada_diffuser.rollout.readout import Reading, Readout
from ada_diffuser.rollout.result import Episode, Evaluation

#: Shown episodes stand side by side, at most so many, and so many steps of each: a wind may turn every dozen steps.
EPISODES_SHOWN = 3
STEPS_SHOWN = 80
#: Where an environment draws ways in the place of a context.
WAYS_SHOWN = 8
#: Latents in a picture, every so many-th of them.
LATENTS_SHOWN = 2000
#: Of a model, and of its episodes that failed.
COLOURS = (("C0", "C9"), ("C3", "C1"), ("C2", "C8"), ("C4", "C6"))


def save_plot(readings: Sequence[Reading], path: Path) -> None:
    """Writes the picture of models on the same episodes, in the format that the suffix names (png, pdf, svg)."""
    figure, (rewards, returns, context) = pyplot().subplots(3, 1, figsize=(9, 9), height_ratios=(2, 2, 3), layout="constrained")
    figure.suptitle("\n".join(_title(one.result) for one in readings))
    for one, (colour, lost) in zip(readings, itertools.cycle(COLOURS)):
        _draw_rewards(rewards, one.result, colour)
        _draw_returns(returns, one.result, colour, lost)
    rewards.set(xlabel="step", ylabel="reward")
    rewards.legend(loc="lower right", fontsize=8, title="mean, and 10 to 90 %", title_fontsize=8)
    returns.set(xlabel="step", ylabel="return so far")
    returns.legend(loc="lower left", fontsize=8)
    if not _draw_ways(context, readings):
        _draw_context(context, _knows(readings))
    save(figure, path)


def _title(result: Evaluation) -> str:
    mean = f"return {result.mean_return:.1f} ± {result.standard_error:.1f}"
    return f"{result.model.name} on {result.trial.env}: {mean} over {len(result.episodes)} episodes"


def _knows(readings: Sequence[Reading]) -> Reading:
    """The first of them whose latent tells something; the first of all where none does."""
    return next((one for one in readings if isinstance(one.readout, Readout)), readings[0])


def save_latents(readings: Sequence[Reading], path: Path) -> None:
    """Writes the latents of each evaluation on their two principal axes, coloured by the true context's bin and by k-means' group."""
    shown = [(one, one.clusters) for one in readings if one.clusters]
    if not shown:
        raise ValueError(f"there are no latents to draw: {readings[0].readout}")
    figure, axes = pyplot().subplots(len(shown), 2, figsize=(10, 4.5 * len(shown)), squeeze=False, layout="constrained")
    for (left, right), (one, clusters) in zip(axes, shown, strict=True):
        _draw_plane(left, clusters, clusters.bins, "bin of the true context, low to high")
        options = " ".join(f"{name}={value}" for name, value in one.result.trial.options.given().items())
        left.set_title(f"{one.result.model.name} on {one.result.trial.env} {options}", fontsize=10)
        _draw_plane(right, clusters, clusters.groups, "group by k-means")
        right.set_title(f"adjusted Rand index {clusters.adjusted_rand_index:.2f}, purity {clusters.purity:.2f}", fontsize=10)
    save(figure, path)


def _draw_plane(axes: Any, clusters: Clusters, labels: np.ndarray[Any, Any], title: str) -> None:
    step = -(-len(labels) // LATENTS_SHOWN)
    for label in range(int(labels.max()) + 1):
        x, y = clusters.plane[::step][labels[::step] == label].T
        axes.plot(x, y, ".", markersize=3, alpha=0.6, color=f"C{label}", label=str(label))
    axes.set(xlabel=f"first axis, {100 * clusters.shares[0]:.0f} % of the variance", ylabel=f"second, {100 * clusters.shares[1]:.0f} %")
    axes.legend(title=title, title_fontsize=8, ncols=5, fontsize=8, markerscale=3, loc="best")


def pyplot() -> Any:
    """matplotlib's, without a screen."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def save(figure: Any, path: Path) -> None:
    """Writes and closes a figure; the same figure gives the same bytes."""
    figure.savefig(path, dpi=120, metadata={"Software": None} if path.suffix == ".png" else None)
    pyplot().close(figure)


def _draw_rewards(axes: Any, result: Evaluation, colour: str) -> None:
    rewards = _padded([episode.rewards for episode in result.episodes])
    steps = np.arange(rewards.shape[1])
    axes.plot(steps, np.nanmean(rewards, axis=0), color=colour, label=result.model.name)
    axes.fill_between(steps, *np.nanpercentile(rewards, (10, 90), axis=0), color=colour, alpha=0.2)


def _draw_returns(axes: Any, result: Evaluation, colour: str, lost: str) -> None:
    """Each episode, those that the environment calls failed in a colour of their own, and their mean."""
    for episode in result.episodes:
        axes.plot(np.cumsum(episode.rewards), color=lost if episode.failed else colour, alpha=0.35, linewidth=0.8)
    mean = np.nanmean(_padded([np.cumsum(episode.rewards).tolist() for episode in result.episodes]), axis=0)
    axes.plot(mean, color="black", linewidth=3)
    axes.plot(mean, color=colour, label=result.model.name)


def _draw_ways(axes: Any, readings: Sequence[Reading]) -> bool:
    """Where the episodes went, in an environment that draws that itself; False: it does not."""
    trial = readings[0].result.trial
    env = environments.make(trial.env, episode_steps=trial.episode_steps, **trial.env_options)
    with closing(env):
        draw = getattr(env.unwrapped, "draw_ways", None)
        if not callable(draw):
            return False
        for one, (colour, _) in zip(readings, itertools.cycle(COLOURS)):
            shown = one.result.episodes[:WAYS_SHOWN]
            draw(axes, [(np.array(episode.states), episode.goal) for episode in shown], colour)
    axes.set_title(f"ways of the first {len(readings[0].result.episodes[:WAYS_SHOWN])} episodes", fontsize=10)
    return True


def _draw_context(axes: Any, reading: Reading) -> None:
    result, readout = reading.result, reading.readout
    read = readout if isinstance(readout, Readout) else None
    first = read.first_shown if read else 0
    offset = 0
    for n, episode in enumerate(result.episodes[first : first + EPISODES_SHOWN]):
        _draw_one_context(axes, episode, read, offset, labelled=n == 0)
        offset += min(STEPS_SHOWN, len(episode.rewards))
        axes.axvline(offset, color="0.8", linewidth=0.8)
    axes.set(xlabel=f"step, the first {STEPS_SHOWN} of each episode", ylabel="hidden context")
    title = (
        f"true context, and read out of the latent of {result.model.name} (R² = {read.r2:.3f} on episodes not fitted)" if read else readout
    )
    axes.set_title(title, fontsize=10)
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))


def _draw_one_context(axes: Any, episode: Episode, read: Readout | None, offset: int, *, labelled: bool) -> None:
    if not episode.contexts:
        return
    true = np.array(episode.contexts[:STEPS_SHOWN])
    steps = offset + np.arange(len(true))
    shown = [step for step in episode.act_steps if step < STEPS_SHOWN]
    seen = read.of(episode)[: len(shown)] if read else None
    for i in range(true.shape[1]):
        name = f" {i}" if true.shape[1] > 1 else ""
        axes.plot(steps, true[:, i], color=f"C{2 * i}", label=f"true{name}" if labelled else None)
        if seen is not None:
            at = offset + np.array(shown)
            label = f"read out{name}" if labelled else None
            axes.plot(at, seen[:, i], ".-", color=f"C{2 * i + 1}", markersize=3, linewidth=0.8, label=label)


def _padded(rows: list[list[float]]) -> np.ndarray[Any, Any]:
    """Rows of different lengths as one array, NaN where a row has ended."""
    table = np.full((len(rows), max(map(len, rows))), np.nan)
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    return table
