"""How a quantity changes over time, whatever single samples do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Samples that slopes are taken between; more are thinned out.
POINTS = 600


def slope(samples: Sequence[tuple[float, float]]) -> float:
    """Median of the slopes between all pairs of (time, value) (Theil and Sen), which a third of wild samples does not move."""
    points = np.array(samples, np.float64)
    points = points[:: max(1, len(points) // POINTS)]
    first, second = np.triu_indices(len(points), 1)
    run, rise = (points[second] - points[first]).T
    return float(np.median(rise / run))
