"""Writes the data sets that the trainer's tests read: python tests/golden/make_h5.py (numpy and h5py needed).

A leaky integrator of three states pushed by two actions and by a hidden push that is constant within an episode and is logged in
infos/context; and the ways in which such a file can be wrong. h5py writes booleans as HDF5 enums, as D4RL's files have them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

EPISODES, STEPS = 12, 24


def episodes() -> dict[str, Any]:
    rng = np.random.default_rng(0)
    rows: dict[str, list[Any]] = {name: [] for name in ("observations", "actions", "rewards", "context")}
    for _ in range(EPISODES):
        state, push = rng.normal(size=3), rng.normal(size=1)
        for _ in range(STEPS):
            action = np.clip(-0.5 * state[:2] + 0.3 * rng.normal(size=2), -1, 1)
            rows["observations"].append(state)
            rows["actions"].append(action)
            rows["rewards"].append(-np.abs(state).sum())
            rows["context"].append(push)
            state = 0.8 * state + 0.4 * np.append(action, push) + 0.02 * rng.normal(size=3)
    ends = np.arange(1, EPISODES * STEPS + 1) % STEPS == 0
    arrays: dict[str, Any] = {name: np.array(values, np.float32) for name, values in rows.items()}
    arrays["infos/context"] = arrays.pop("context")
    # The second half ends by terminals, the first by timeouts: both end an episode.
    half = np.arange(len(ends)) >= len(ends) // 2
    return arrays | {"terminals": ends & half, "timeouts": ends & ~half}


def write(name: str, arrays: dict[str, Any]) -> None:
    with h5py.File(Path(__file__).parent / f"data_{name}.h5", "w", track_order=False) as file:
        for key, values in arrays.items():
            file.create_dataset(key, data=values, compression="gzip" if values.ndim == 2 else None)


def main() -> None:
    good = episodes()
    write("good", good)
    write("f64", {key: values.astype(np.float64) if values.dtype == np.float32 else values for key, values in good.items()})
    write("no_actions", {key: values for key, values in good.items() if key != "actions"})
    write("ragged", good | {"rewards": good["rewards"][:-3]})
    write("flat", good | {"observations": good["observations"].reshape(-1, 3, 1)})
    write("still", good | {"infos/context": np.ones_like(good["infos/context"])})
    spoiled = good["observations"].copy()
    spoiled[30, 2] = np.nan
    write("nan", good | {"observations": spoiled})


if __name__ == "__main__":
    main()
