"""What a client is told when the server fails over its act: a real server that breaks as it is told to."""

from __future__ import annotations

from pathlib import Path

import pytest
from server import running

from ada_diffuser import AdaError, Client, PoisonStep, ServerFault

STATE = [0.1, -0.2, 0.3, 0.4]
POISON, BROKEN = [7.0, *STATE[1:]], [8.0, *STATE[1:]]


def test_an_act_over_which_the_server_fails_is_named_and_not_sent_again(tmp_path: Path) -> None:
    faults = ("--fault", "evaluating=panic@state=7", "--fault", "evaluating=nonfinite@state=8")
    with running(tmp_path / "log", "--default-model", "tiny", *faults) as address:
        for face in ("grpc", "http"):
            with Client(f"{face}://{address}") as client, client.open_session("tiny", seed=1) as session:
                with pytest.raises(PoisonStep, match="act with another observation, or reset the session") as first:
                    session.act(POISON)
                with pytest.raises(PoisonStep) as again:
                    session.act(POISON)
                assert again.value.error_id == first.value.error_id != "", "it is not tried again"
                with pytest.raises(ServerFault) as broken:
                    session.act(BROKEN)
                assert broken.value.reason == "NONFINITE_OUTPUT"
                (batched,) = client.act_batch([session], [POISON])
                assert isinstance(batched, AdaError) and type(batched) is PoisonStep
                assert session.act(STATE).step == 1, "the session stands where it stood"
                session.reset(seed=1)
                assert session.act(STATE).step == 1
