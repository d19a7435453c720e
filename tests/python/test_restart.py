"""Same seed, same observations: same bytes, before and after a crash of the server, whatever the face and the number of threads."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from server import running

from ada_diffuser import Client
from ada_diffuser.messages import SamplerOptions

STATES = np.random.default_rng(3).normal(size=(6, 17)).astype(np.float32)
NOISY = SamplerOptions(temperature=1.0, eta=1.0, latent="sample")


def episode(url: str) -> bytes:
    """Every number of six acts of the default model, two of them with rewards."""
    with Client(url) as client, client.open_session(model="cheetah-wind-s", seed=11, options=NOISY) as session:
        chunks = [session.act(state, reward=[-0.5] if step in (2, 4) else None) for step, state in enumerate(STATES)]
        parts = [part for chunk in chunks for part in (chunk.actions, chunk.latent_mean, chunk.latent_log_var, chunk.predicted_state)]
        return b"".join(np.ascontiguousarray(part).tobytes() for part in parts)


@pytest.mark.parametrize("face", ["grpc", "http"])
def test_a_crash_changes_no_byte(face: str, tmp_path: Path) -> None:
    with running(tmp_path / "first", "--set", "engine.workers=1", kill=True) as address:
        before = episode(f"grpc://{address}")
    with running(tmp_path / "second", "--set", "engine.workers=2") as address:
        assert episode(f"{face}://{address}") == before
