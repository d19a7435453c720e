"""A client keeps its session as a sealed token, and goes on with it on a server that has never heard of it."""

from __future__ import annotations

import base64
import os
from pathlib import Path

import numpy as np
import pytest
from server import ROOT, running

from ada_diffuser import Client, InvalidInput, SessionGone, StepConflict, TokenExpired, TokenStale

MODELS = ("--models", str(ROOT / "models"), "--default-model", "tiny")
#: What a session sees at a step.
STATES = np.sin(np.arange(40, dtype=np.float32).reshape(10, 4) * 0.37)


@pytest.mark.parametrize("face", ["grpc", "http"])
def test_a_session_goes_on_from_its_token(tmp_path: Path, face: str) -> None:
    keys = tmp_path / "keys"
    keys.touch(mode=0o600)
    keys.write_bytes(base64.b64encode(os.urandom(32)))
    sealing = ("--set", f"tokens.key_file={keys}")
    with running(tmp_path / "first.log", *MODELS, *sealing) as address, Client(f"{face}://{address}") as client:
        session = client.open_session("tiny", seed=3)
        first = session.act(STATES[0])
        token = session.token()
        second = session.act(STATES[1])
        with pytest.raises(TokenStale, match="attach") as stale:
            client.resume(token)
        assert isinstance(stale.value, StepConflict) and stale.value.committed_step == 2
    with running(tmp_path / "second.log", *MODELS, *sealing) as address, Client(f"{face}://{address}") as client:
        again = client.resume(memoryview(token))
        assert (again.session_id, again.seed, again.committed_step) == (session.session_id, 3, 1)
        lost = client.attach(again.session_id, committed_step=0).act(STATES[0])
        assert lost.replayed and np.array_equal(lost.actions, first.actions)
        assert np.array_equal(again.act(STATES[1]).actions, second.actions), "what was lost with the first server comes out as it was"
        with pytest.raises(InvalidInput, match="token"):
            client.resume(token[:-1])
        with pytest.raises(InvalidInput, match="no bytes"):
            client.resume("token")  # type: ignore[arg-type]
    assert issubclass(TokenExpired, SessionGone)


@pytest.mark.parametrize("face", ["grpc", "http"])
def test_a_server_without_a_key_says_so(tmp_path: Path, face: str) -> None:
    with running(tmp_path / "log", *MODELS) as address, Client(f"{face}://{address}") as client, client.open_session("tiny") as session:
        with pytest.raises(InvalidInput, match=r"tokens\.key_file"):
            session.token()
        with pytest.raises(InvalidInput, match=r"tokens\.key_file"):
            client.resume(b"ADAT")
