"""The client against the real server on the tiny model: both faces, retries over cut connections, rollouts, bad input.

The binary is `$ADA_SERVER`, else `target/release/ada-server`. Without one these tests are skipped, except where `CI=true`.
"""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ada_diffuser import (
    Chunk,
    ChunkBroker,
    Client,
    Executed,
    InvalidInput,
    NotFound,
    Observation,
    PayloadMismatch,
    RetryPolicy,
    SamplerOptions,
    Session,
    StepConflict,
    Unavailable,
)
from ada_diffuser.commands import evaluate as evaluate_command
from ada_diffuser.commands import rollout as rollout_command
from ada_diffuser.options import KINDS
from ada_diffuser.rollout import Trial, evaluate

FACES = ("grpc", "http")
STATES = np.random.default_rng(0).uniform(-0.5, 0.5, (8, 4)).astype(np.float32)


@pytest.fixture(params=FACES)
def client(address: str, request: pytest.FixtureRequest) -> Iterator[Client]:
    with Client(f"{request.param}://{address}") as client:
        yield client


@dataclass
class Cutter:
    """A proxy that can swallow what the server sends: the next time it answers, both ends are closed instead."""

    target: tuple[str, int]
    cut: threading.Event = field(default_factory=threading.Event)
    cuts: int = 0

    def __post_init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                inner, _ = self.listener.accept()
            except OSError:
                return
            outer = socket.create_connection(self.target)
            threading.Thread(target=self._pump, args=(inner, outer, False), daemon=True).start()
            threading.Thread(target=self._pump, args=(outer, inner, True), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, answers: bool) -> None:
        try:
            while data := source.recv(65536):
                # HTTP/2 pings and settings are small; an act's answer holds some hundred bytes of floats.
                if answers and len(data) > 200 and self.cut.is_set():
                    self.cut.clear()
                    self.cuts += 1
                    break
                sink.sendall(data)
        except OSError:
            pass
        for end in (source, sink):
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                continue


def drive(session: Session, acts: int = 5) -> list[Chunk]:
    """Acts on fixed states with fixed rewards."""
    chunks = [session.act(STATES[0])]
    for i in range(1, acts):
        chunks.append(session.act(STATES[i], reward=-0.1 * i, planned_states=i == 2))
    return chunks


def substance(chunk: Chunk) -> tuple[object, ...]:
    """What must be the same bytes, wherever the act ran."""
    arrays = (chunk.actions, chunk.latent_mean, chunk.latent_log_var, chunk.predicted_state)
    return (*(array.tobytes() for array in arrays), chunk.evaluations, chunk.start, chunk.model_digest, chunk.step)


def test_the_same_bytes_by_both_faces_and_in_a_batch(address: str) -> None:
    runs = []
    for face in FACES:
        with Client(f"{face}://{address}") as client:
            with client.open_session("tiny", seed=7) as session:
                chunks = drive(session)
                assert chunks[2].planned_states is not None and chunks[1].planned_states is None
                assert chunks[2].planned_states.shape == (session.model.plan_horizon - 1, session.model.state_dim)
                runs.append([substance(chunk) for chunk in chunks])
            sessions = [client.open_session("tiny", seed=seed) for seed in (3, 7, 9)]
            batches = []
            for i, state in enumerate(STATES[:5]):
                told = () if i == 0 else (Executed(reward=-0.1 * i),)
                batches.append(client.act_batch([(session, Observation(state, told)) for session in sessions]))
            runs.append([substance(batch[1]) for batch in batches])
            assert batches[0][0].actions.tobytes() != batches[0][1].actions.tobytes(), "another seed, other actions"
    assert runs[0] == runs[1] == runs[2] == runs[3]


def test_what_a_client_must_know(client: Client) -> None:
    (tiny,) = client.models()
    assert tiny.name == "tiny" and tiny.is_default and len(tiny.digest) == 64
    assert client.model().digest == client.model(f"tiny@{tiny.digest[:8]}").digest == tiny.digest
    assert len(tiny.action_low) == len(tiny.action_high) == tiny.action_dim
    assert set(KINDS) - set(tiny.sampler.given()) == {"told_return", "told_goal"}, "every default is said, and nothing is told"
    assert (tiny.told, tiny.returns, tiny.guide, tiny.context) == ((), None, False, None)
    assert tiny.sampler.action_horizon in tiny.trained.action_horizons and tiny.trained.missing.reward
    wanted = SamplerOptions(streaming=False, temperature=0.5, latent="sample", kappa=0.0)
    with client.open_session(seed=2**53 - 1, options=wanted, ttl_ms=60_000) as session:
        assert session.seed == 2**53 - 1
        assert {**session.options.given(), **wanted.given()} == session.options.given()
        chunk = session.act(STATES[0])
        assert chunk.actions.shape == (session.options.action_horizon, tiny.action_dim)
        assert not chunk.replayed and chunk.start == "cold" and chunk.evaluations > 0 and chunk.timings.total_us > 0
        summary = session.summary()
        assert (summary.committed_step, summary.ttl_ms, summary.model) == (1, 60_000, "tiny")
        assert np.array_equal(summary.latent_mean, chunk.latent_mean)
        listed = {other.handle: other.session_id for other in client.sessions(model="tiny", page_size=1)}
        assert listed[session.summary().handle] == "", "a list is no right to use what it lists"
        again = client.attach(session.session_id)
        assert again.act(STATES[1]).step == 2
    with pytest.raises(NotFound):
        client.summary(session.session_id)


@pytest.mark.parametrize("face", FACES)
def test_an_answer_lost_on_the_way_comes_again(address: str, face: str) -> None:
    """The connection ends when the server has acted and answers: the retry gets that answer, replayed."""
    host, port = address.split(":")
    proxy = Cutter((host, int(port)))
    with Client(f"grpc://{address}") as direct, direct.open_session(seed=5) as session:
        expected = [substance(chunk) for chunk in drive(session, 3)]
    retry = RetryPolicy(base_s=0.05)
    with Client(f"{face}://127.0.0.1:{proxy.port}", retry=retry) as client, client.open_session(seed=5) as session:
        chunks = [session.act(STATES[0])]
        proxy.cut.set()
        chunks.append(session.act(STATES[1], reward=-0.1))
        chunks.append(session.act(STATES[2], reward=-0.2))
    proxy.listener.close()
    assert proxy.cuts == 1
    assert [chunk.replayed for chunk in chunks] == [False, True, False]
    assert [substance(chunk) for chunk in chunks] == expected


def test_without_retries_the_same_observation_goes_on(address: str) -> None:
    """The caller may be the one who retries: the session stands, and the same observation gets the answer that was lost."""
    host, port = address.split(":")
    proxy = Cutter((host, int(port)))
    with Client(f"http://127.0.0.1:{proxy.port}", retry=RetryPolicy(attempts=1)) as client, client.open_session() as session:
        proxy.cut.set()
        with pytest.raises(Unavailable):
            session.act(STATES[0])
        assert session.committed_step == 0
        with pytest.raises(PayloadMismatch) as caught:
            session.act(STATES[1])
        assert caught.value.committed_step == 1
        assert session.act(STATES[0]).replayed and session.committed_step == 1
    proxy.listener.close()


def test_the_broker_over_steps_equals_acting_by_hand(client: Client) -> None:
    options = SamplerOptions(action_horizon=2)
    with client.open_session(seed=4, options=options) as session:
        broker, actions = ChunkBroker(session), []
        for i in range(5):
            actions.append(broker.action(STATES[i]))
            broker.report(reward=0.5 * i)
        assert session.committed_step == 3
    with client.open_session(seed=4, options=options) as session:
        first = session.act(STATES[0])
        told = [Executed(reward=0.0), Executed(STATES[1], reward=0.5)]
        second = session.act(STATES[2], told)
        third = session.act(STATES[4], [Executed(reward=1.0), Executed(STATES[3], reward=1.5)])
    by_hand = np.concatenate([first.actions, second.actions, third.actions[:1]])
    assert np.array_equal(np.array(actions), by_hand)


def test_a_plan_that_nobody_executed_leaves_no_trace(client: Client) -> None:
    """`replan()` before the first action of a chunk told the server that the whole chunk had been executed, for want of words."""
    options = SamplerOptions(action_horizon=2, streaming=False)
    with client.open_session(seed=4, options=options) as session:
        expected = [substance(chunk)[:-1] for chunk in drive(session, 2)]
    with client.open_session(seed=4, options=options) as session:
        session.act(STATES[7])
        assert substance(session.act(STATES[0], nothing_executed=True))[:-1] == expected[0]
        with pytest.raises(InvalidInput) as caught:
            session.act(STATES[1], [Executed()], nothing_executed=True)
        assert caught.value.field == "observation.nothing_executed"
        assert substance(session.act(STATES[1], reward=-0.1))[:-1] == expected[1]
    with client.open_session(seed=4, options=options) as session:
        broker = ChunkBroker(session)
        broker.accept(session.act(STATES[7]))
        broker.replan()
        broker.action(STATES[0])
        broker.report(reward=-0.1)
        for _ in range(2):  # the second one replaces the first
            broker.replan()
            (answer,) = client.act_batch([(session, broker.observation(STATES[1]))])
            assert isinstance(answer, Chunk)
            broker.accept(answer)
        assert substance(answer)[:-1] == expected[1] and session.committed_step == 4


def test_a_session_catches_up_after_a_break(client: Client) -> None:
    """More steps than were returned are a past like any other; a new session is primed by the same."""
    driven = [Executed(STATES[i], [0.1 * i, -0.1], 0.5) for i in range(5)]
    with client.open_session(seed=4) as session:
        session.act(STATES[0])
        caught_up = session.act(STATES[5], driven)
    with client.open_session(seed=4) as session:
        primed = session.act(STATES[5], driven)
    assert substance(caught_up)[:-1] == substance(primed)[:-1]


def test_a_reset_is_a_new_session(client: Client) -> None:
    with client.open_session(seed=1) as session:
        first = [substance(chunk) for chunk in drive(session, 3)]
        session.reset(seed=2)
        assert session.seed == 2 and session.committed_step == 0
        other = [substance(chunk) for chunk in drive(session, 3)]
        session.reset(seed=1)
        assert [substance(chunk) for chunk in drive(session, 3)] == first != other
        session.reset(seed=1, keep_history=True)
        kept = session.act(STATES[0])
        assert kept.latent_mean.tobytes() != first[0][1], "the latent still looks back on the old episode"


WRONG_OPTIONS = (
    *(SamplerOptions(action_horizon=10_000), SamplerOptions(kappa=-1.0), SamplerOptions(sub_steps=0)),
    *(SamplerOptions(guidance_scale=1.0), SamplerOptions(candidates=2, streaming=False), SamplerOptions(picard_window=0)),
    *(SamplerOptions(told_return=1.0), SamplerOptions(told_goal=(0.5, 0.5)), SamplerOptions(free_guidance_scale=2.0)),
)


def test_wrong_input_is_named_alike_by_both_faces(address: str) -> None:
    def complaints(face: str) -> list[tuple[str, str, str]]:
        told = []
        with Client(f"{face}://{address}") as client, client.open_session(seed=1) as session:
            wrong_acts = [
                ([0.0] * 3, ()),
                ([0.0] * 4, (Executed(action=[0.0] * 3),)),
                ([0.0] * 4, (Executed(action=[0.0]),)),
            ]
            for state, executed in wrong_acts:
                with pytest.raises(InvalidInput) as caught:
                    session.act(state, executed)
                told.append((caught.value.reason, caught.value.field, caught.value.message))
            with pytest.raises(InvalidInput) as caught:
                session.act([0.0] * 4, context=[[0.0, 0.0]])
            told.append((caught.value.reason, caught.value.field, caught.value.message))
            for options in WRONG_OPTIONS:
                with pytest.raises(InvalidInput) as caught:
                    client.open_session(options=options)
                told.append((caught.value.reason, caught.value.field, caught.value.message))
            with pytest.raises(NotFound) as missing:
                client.open_session("no-such-model")
            told.append((missing.value.reason, missing.value.field, missing.value.message))
            assert session.act(STATES[0]).step == 1, "nothing was lost"
            session._committed_step = 7
            with pytest.raises(StepConflict) as conflict:
                session.act(STATES[0])
            told.append((conflict.value.reason, str(conflict.value.committed_step), conflict.value.message))
            assert session.catch_up() == 1
            session.close()
            with pytest.raises(NotFound) as closed:
                session.act(STATES[0])
            told.append((closed.value.reason, closed.value.field, closed.value.message))
        return told

    by_grpc, by_http = (complaints(face) for face in FACES)
    assert by_grpc == by_http
    assert [reason for reason, _, _ in by_grpc] == [
        *("OBSERVATION_INVALID",) * 4,
        *("OPTIONS_INVALID",) * len(WRONG_OPTIONS),
        *("MODEL_NOT_FOUND", "STEP_OUT_OF_ORDER", "SESSION_NOT_FOUND"),
    ]
    assert (by_grpc[1][1], by_grpc[3][1]) == ("observation.executed[0].action", "observation.context")


def test_rollouts_are_the_same_by_both_faces_alone_and_in_a_batch(address: str) -> None:
    trials = {
        "grpc alone": ("grpc", Trial("point-wind-s", episodes=2, seed=3)),
        "http alone": ("http", Trial("point-wind-s", episodes=2, seed=3)),
        "batch": ("grpc", Trial("point-wind-s", episodes=2, seed=3, vector=2)),
    }
    returns = {}
    for name, (face, trial) in trials.items():
        with Client(f"{face}://{address}") as client:
            before = {session.handle for session in client.sessions()}
            result = evaluate(client, trial)
            returns[name] = result.returns.tolist()
            assert result.acts.acts == 2 * 200 / result.options.action_horizon and result.acts.replayed == 0
            assert {session.handle for session in client.sessions()} <= before, "a rollout closes its sessions"
    assert returns["grpc alone"] == returns["http alone"] == returns["batch"]


def test_a_session_goes_on_elsewhere_and_twice(address: str) -> None:
    """What was exported by one face is imported by the other, answers the same, and is no longer bound to the first."""
    noisy = SamplerOptions(temperature=1.0, eta=0.5, latent="sample")
    for face, other in (FACES, FACES[::-1]):
        with Client(f"{face}://{address}") as here, Client(f"{other}://{address}") as there:
            with here.open_session("tiny", seed=8, options=noisy, ttl_ms=70_000) as session:
                last = drive(session, 3)[-1]
                record = session.export()
                twin, fork = session.fork(), session.fork(seed=9, ttl_ms=80_000)
                expected = [substance(chunk)[:-1] for chunk in drive(session, 3)]
            gone_on = there.import_session(record)
            assert (gone_on.committed_step, gone_on.seed, gone_on.options.eta) == (3, 8, 0.5)
            assert (gone_on.summary().ttl_ms, fork.summary().ttl_ms, fork.seed) == (70_000, 80_000, 9)
            assert len({session.session_id, gone_on.session_id, twin.session_id, fork.session_id}) == 4
            gone_on._committed_step = 2  # as if the answer of the last act had been lost
            lost = gone_on.act(STATES[2], reward=-0.2)
            assert lost.replayed and substance(lost)[:-1] == substance(last)[:-1]
            for goes_on in (gone_on, twin):
                assert [substance(chunk)[:-1] for chunk in drive(goes_on, 3)] == expected
            otherwise = [substance(chunk)[:-1] for chunk in drive(fork, 3)]
            assert all(a != b for a, b in zip(otherwise, expected, strict=True))
            moved = there.attach(gone_on.session_id)
            moved._committed_step = 2
            with pytest.raises(StepConflict) as caught:
                moved.fork()
            assert (caught.value.reason, caught.value.committed_step) == ("STEP_OUT_OF_ORDER", 6)
            for rest in (gone_on, twin, fork):
                rest.close()


def test_what_cannot_be_imported_says_why(client: Client) -> None:
    with client.open_session("tiny", seed=8) as session:
        record = bytearray(session.export())
        assert client.import_session(memoryview(record)).committed_step == 0
    for wrong, reason in ((record[:-1], "damaged"), (b"", "no session"), (b"ADAS\xff" + record[5:], "format 255")):
        with pytest.raises(InvalidInput, match=reason) as caught:
            client.import_session(wrong)
        assert (caught.value.reason, caught.value.field) == ("REQUEST_INVALID", "record")
    with pytest.raises(InvalidInput, match="record: is no bytes, but a str"):
        client.import_session("ADAS")  # type: ignore[arg-type]
    with pytest.raises(NotFound):
        session.export()
    with pytest.raises(NotFound):
        session.fork()


def test_an_episode_that_is_over_takes_no_act(client: Client) -> None:
    """Whoever drove a session that somebody else had reset drove the new episode, and did not know."""
    with client.open_session("tiny", seed=3) as session:
        session.act(STATES[0])
        other = client.attach(session.session_id)
        other.reset(seed=4)
        with pytest.raises(StepConflict, match="episode 0 does not run; 1 does") as conflict:
            session.act(STATES[1])
        assert conflict.value.reason == "EPISODE_OVER" and conflict.value.committed_step == 0
        assert session.catch_up() == 0 and session.seed == 4
        assert session.act(STATES[1]).step == 1


def test_an_open_or_reset_whose_answer_was_lost_is_done_once(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    face = client._face
    lost = {"open_session": 1, "reset_session": 1}

    def losing(verb: str) -> Callable[..., Any]:
        done = getattr(face, verb)

        def call(*arguments: Any) -> Any:
            answer = done(*arguments)
            if lost[verb]:
                lost[verb] -= 1
                raise Unavailable("the answer was lost")
            return answer

        return call

    for verb in lost:
        monkeypatch.setattr(face, verb, losing(verb))
    before = {session.handle for session in client.sessions()}
    with client.open_session("tiny") as session:
        assert {other.handle for other in client.sessions()} - before == {session.summary().handle}
        session.act(STATES[0])
        session.reset(seed=9)
        assert session.summary().episode == 1 and session.act(STATES[0]).step == 1
    assert not any(lost.values())


def test_rewards_are_withheld_when_asked(address: str) -> None:
    """What a model is worth without rewards could only be measured by a script that patched the client."""
    with Client(f"grpc://{address}") as client:
        told, withheld = (
            evaluate(client, Trial("point-wind-s", episodes=2, seed=3, vector=2, withhold_rewards=withhold)) for withhold in (False, True)
        )
    assert withheld.as_json()["withhold_rewards"] and len(withheld.episodes[0].rewards) == 200, "they are counted all the same"
    assert told.episodes[0].actions[0].tolist() == withheld.episodes[0].actions[0].tolist(), "nothing is told before the first act"
    assert told.returns.tolist() != withheld.returns.tolist()


def test_an_environment_that_does_not_fit_is_refused(client: Client) -> None:
    with pytest.raises(ValueError, match="17 state and 6 action values, but model tiny has 4 and 2"):
        evaluate(client, Trial("cheetah-wind-s", episodes=1))


def test_the_commands_leave_what_they_promise(address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = {name: tmp_path / f"rollout.{name}" for name in ("png", "gif", "json")}
    words = ["--env", "point-wind-s", "--face", "http", "--url", address, "--episodes", "2", "--seed", "3", "--vector", "2"]
    files = ["--plot", str(names["png"]), "--film", str(names["gif"]), "--json", str(names["json"])]
    assert rollout_command.main([*words, *files, "--option", "streaming=false"]) == 0
    shown = capsys.readouterr().out
    assert "mean return" in shown and "0 replayed" in shown and "streaming=false" in shown
    assert len(json.loads(names["json"].read_text())["returns"]) == 2
    for picture in ("png", "gif"):
        with Image.open(names[picture]) as opened:
            assert min(opened.size) > 100
    assert rollout_command.main([*words, "--json", str(names["json"]), "--model", "tiny", "--beside", "tiny"]) == 0
    first, beside = json.loads(names["json"].read_text())
    assert first["returns"] == beside["returns"] and "+0.00 ± 0.00" in capsys.readouterr().out
    assert rollout_command.main([*words, "--beside", "tiny", "nobody"]) == 1
    assert "nobody" in capsys.readouterr().err, "before the first episode"

    words = ["--env", "point-wind-s", "--url", address, "--models", "tiny", "--episodes", "2", "--seed", "3", "--markdown"]
    grid = [*words, "--set", "streaming=true,false", "--set", "temperature=0,1", "--json", str(names["json"])]
    assert evaluate_command.main(grid) == 0
    assert len(capsys.readouterr().out.strip().splitlines()) == 2 + 4
    stored = json.loads(names["json"].read_text())
    assert [(row["options"]["streaming"], row["options"]["temperature"]) for row in stored] == [
        *((True, 0.0), (True, 1.0), (False, 0.0), (False, 1.0))
    ]
