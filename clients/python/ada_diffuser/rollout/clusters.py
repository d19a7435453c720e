"""Do latents fall into groups, and are these groups of like contexts? As the paper asks it: five groups by k-means, held against five
bins of the true context with as many acts in each; for the eye the two principal axes in the place of its t-SNE."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Labels = NDArray[np.int64]

#: Bins of the context, and groups of latents.
GROUPS = 5
#: Beginnings of k-means, of which the best end counts, and updates of each at most.
TRIES, UPDATES_MAX = 10, 100


@dataclass(frozen=True, eq=False)
class Clusters:
    """The latents of all acts, once grouped by themselves and once by the true context."""

    #: On the two axes along which they vary most, `(acts, 2)`; the second is 0 for a latent of one value.
    plane: Points
    #: Share of their variance on each of the two axes.
    shares: tuple[float, float]
    #: Bin of the true context at each act, low to high; fewer than `GROUPS` where it has fewer values.
    bins: Labels
    #: Group of each act by k-means, as many as there are bins.
    groups: Labels

    @property
    def adjusted_rand_index(self) -> float:
        """1: the groups are the bins; 0: as alike as by chance."""
        return adjusted_rand_index(self.bins, self.groups)

    @property
    def purity(self) -> float:
        """Share of acts whose bin is the most frequent one of their group; with even bins chance is a little over one over their number."""
        return float(_table(self.groups, self.bins).max(axis=1).sum() / len(self.bins))

    def as_json(self) -> dict[str, Any]:
        return {
            "groups": int(self.bins.max()) + 1,
            "acts": len(self.bins),
            "adjusted_rand_index": round(self.adjusted_rand_index, 6),
            "purity": round(self.purity, 6),
        }


def cluster(latents: Points, contexts: Points, groups: int = GROUPS) -> Clusters:
    """Groups `(acts, latent_dim)` and `(acts, context_dim)`; a context of several values is binned along the axis of most variance."""
    bins = _bins(on_axes(contexts)[0][:, 0], groups)
    plane, shares = on_axes(latents)
    return Clusters(plane, shares, bins, kmeans(latents, int(bins.max()) + 1))


def adjusted_rand_index(a: Labels, b: Labels) -> float:
    """Hubert and Arabie's: pairs that both put together, less those by chance, as a share of the most possible."""
    table = _table(a, b)
    both, of_a, of_b, of_all = (float(_pairs(n).sum()) for n in (table, table.sum(axis=1), table.sum(axis=0), np.array(len(a))))
    chance = of_a * of_b / of_all
    most = (of_a + of_b) / 2
    return 1.0 if most == chance else (both - chance) / (most - chance)


def kmeans(points: Points, groups: int, seed: int = 0) -> Labels:
    """Lloyd's algorithm from k-means++ beginnings, the best of `TRIES`; the same points give the same labels."""
    rng = np.random.default_rng(seed)
    tries = [_lloyd(points, _spread_out(points, groups, rng)) for _ in range(TRIES)]
    return min(tries, key=lambda found: found[1])[0]


def _lloyd(points: Points, centres: Points) -> tuple[Labels, float]:
    labels = np.full(len(points), -1)
    for _ in range(UPDATES_MAX):
        distances = _squared_distances(points, centres)
        before, labels = labels, distances.argmin(axis=1)
        if np.array_equal(before, labels):
            break
        for group in np.unique(labels):
            centres[group] = points[labels == group].mean(axis=0)
    return labels, float(_squared_distances(points, centres)[np.arange(len(points)), labels].sum())


def _spread_out(points: Points, groups: int, rng: np.random.Generator) -> Points:
    """Points of their own as centres, each drawn with the square of its distance to those before (k-means++)."""
    centres = points[rng.integers(len(points), size=1)]
    while len(centres) < groups:
        distances = _squared_distances(points, centres).min(axis=1)
        total = distances.sum()
        drawn = rng.choice(len(points), p=distances / total if total > 0 else None)
        centres = np.vstack([centres, points[drawn]])
    return centres


def _squared_distances(points: Points, centres: Points) -> Points:
    """`(points, centres)`."""
    return np.stack([((points - centre) ** 2).sum(axis=1) for centre in centres], axis=1)


def on_axes(points: Points) -> tuple[Points, tuple[float, float]]:
    """On the two principal axes, each pointing where its largest part is positive, and their shares of the variance."""
    centred = points - points.mean(axis=0)
    _, sizes, axes = np.linalg.svd(centred, full_matrices=False)
    axes = axes[:2] * np.sign(axes[:2][np.arange(len(axes[:2])), np.abs(axes[:2]).argmax(axis=1)])[:, None]
    plane, shares = np.zeros((len(points), 2)), np.zeros(2)
    plane[:, : len(axes)] = centred @ axes.T
    shares[: len(axes)] = sizes[:2] ** 2 / max(float((sizes**2).sum()), np.finfo(float).tiny)
    return plane, (float(shares[0]), float(shares[1]))


def _bins(values: Points, groups: int) -> Labels:
    """As many values in each as ties allow; like values are never parted, so fewer distinct values make fewer bins."""
    edges = np.quantile(values, np.linspace(0, 1, groups + 1)[1:-1])
    return np.unique(np.searchsorted(edges, values, side="right"), return_inverse=True)[1]


def _table(a: Labels, b: Labels) -> Labels:
    """How many have each pair of labels."""
    table = np.zeros((int(a.max()) + 1, int(b.max()) + 1), np.int64)
    np.add.at(table, (a, b), 1)
    return table


def _pairs(n: NDArray[Any]) -> NDArray[Any]:
    return n * (n - 1) / 2
