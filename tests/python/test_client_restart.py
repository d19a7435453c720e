"""The client over the end of its server: the real one is killed as hard as it can be, and started again on its port and store."""

from __future__ import annotations

import json
import logging
import pickle
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from server import ROOT, Server

from ada_diffuser import (
    AdaError,
    Chunk,
    Client,
    DeadlineExceeded,
    ModelGone,
    RetryPolicy,
    SamplerOptions,
    Session,
    SessionGone,
    StepConflict,
    StoreFull,
    Unavailable,
)
from ada_diffuser.commands import evaluate, rollout
from ada_diffuser.faces import grpc_face
from ada_diffuser.rollout import episodes

FACES = ("grpc", "http")
STATES = np.random.default_rng(5).uniform(-0.5, 0.5, (40, 4)).astype(np.float32)
NOISY = SamplerOptions(temperature=1.0, eta=0.5, latent="sample")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(ROOT / "models/tiny", tmp_path / "models/tiny")
    return tmp_path


@pytest.fixture
def server(folder: Path) -> Iterator[Server]:
    yield from _served(folder, "--store", str(folder / "store"))


@pytest.fixture
def forgetful(folder: Path) -> Iterator[Server]:
    """One without a store."""
    yield from _served(folder)


def _served(folder: Path, *flags: str) -> Iterator[Server]:
    server = Server(folder / "log", "--models", str(folder / "models"), "--default-model", "tiny", *flags)
    try:
        server.start()
        server.wait_ready()
        yield server
    finally:
        server.kill()


def until(condition: Callable[[], bool], within_s: float = 20.0) -> None:
    end = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end, "it does not come about"
        time.sleep(0.002)


def substance(chunk: Chunk | AdaError) -> bytes:
    """All of an answer that must be the same, whichever process gave it."""
    assert isinstance(chunk, Chunk), chunk
    return b"".join(array.tobytes() for array in (chunk.actions, chunk.latent_mean, chunk.latent_log_var, chunk.predicted_state))


def when_ready(server: Server) -> float:
    """The time at which it is, found out by who does nothing else."""
    with Client(f"http://{server.address}", retry=RetryPolicy(attempts=1)) as client:

        def is_ready() -> bool:
            try:
                return bool(client.models())
            except Unavailable:
                return False

        until(is_ready)
        return time.monotonic()


class Callers:
    """Each verb of a client as a call under way, each over a connection of its own that stands already."""

    def __init__(self, url: str, policy: RetryPolicy, timeout_s: float = 30.0) -> None:
        self._opened = [Client(url, timeout_s=timeout_s, retry=policy) for _ in range(12)]
        clients = iter(self._opened)
        self.sessions = [self._session(next(clients)) for _ in range(7)]
        act, batch, reset, export, fork, close, summary = self.sessions
        record = export.export()
        rest = list(clients)
        for client in rest:
            client.models()
        opens, imports, models, model, lists = rest
        self.verbs: dict[str, Callable[[], Any]] = {
            "act": lambda: act.act(STATES[1]),
            "act_batch": lambda: batch._client.act_batch([batch], STATES[1:2])[0],
            "reset": lambda: reset.reset(9),
            "export": export.export,
            "fork": lambda: fork.fork(seed=4).committed_step,
            "close": close.close,
            "summary": lambda: summary.summary().committed_step,
            "open": lambda: substance(opens.open_session(seed=3, options=NOISY).act(STATES[0])),
            "import": lambda: substance(imports.import_session(record).act(STATES[1])),
            "models": lambda: [one.name for one in models.models()],
            "model": lambda: model.model("tiny").name,
            "sessions": lambda: len(list(lists.sessions())) > 0,
        }

    @staticmethod
    def _session(client: Client) -> Session:
        session = client.open_session(seed=3, options=NOISY)
        session.act(STATES[0])
        return session

    def call(self) -> dict[str, Future[tuple[Any, float]]]:
        """What each verb answers or raises, and when."""

        def one(verb: Callable[[], Any]) -> tuple[Any, float]:
            try:
                answer = verb()
            except AdaError as error:
                answer = error
            return answer, time.monotonic()

        self._threads = ThreadPoolExecutor(len(self.verbs))
        return {name: self._threads.submit(one, verb) for name, verb in self.verbs.items()}

    def close(self) -> None:
        for client in self._opened:
            client.close()


@pytest.mark.parametrize("back_s", [0.2, 3.0])
@pytest.mark.parametrize("under_way", [True, False], ids=["under way", "between"])
@pytest.mark.parametrize("face", FACES)
def test_every_verb_outlasts_the_server(
    server: Server, caplog: pytest.LogCaptureFixture, face: str, under_way: bool, back_s: float
) -> None:
    """Six calls in 1.2 s were all that a client had for a server to come back, whatever its budget of 30 s said."""
    expected = Callers(f"{face}://{server.address}", RetryPolicy())
    undisturbed = {name: told.result()[0] for name, told in expected.call().items()}
    callers = Callers(f"{face}://{server.address}", RetryPolicy(budget_s=30))
    if under_way:
        server.freeze()
        calls = callers.call()
        until(lambda: server.unread() >= len(calls))
        server.kill()
    else:
        server.kill()
        calls = callers.call()
    caplog.clear()
    killed = time.monotonic()
    threading.Timer(back_s, server.start).start()
    ready = when_ready(server)
    told = {name: call.result(60) for name, call in calls.items()}
    for name, (answer, answered) in told.items():
        assert not isinstance(answer, AdaError), (name, answer)
        if isinstance(answer, Chunk):
            assert (answer.step, substance(answer)) == (2, substance(undisturbed[name])), name
        elif name != "export":
            assert answer == undisturbed[name], name
        assert answered > killed + back_s and answered - ready < 1, (name, answered - ready, "it is found soon after it is back")
    act, _, reset, _, _, close, _ = callers.sessions
    assert (reset.committed_step, reset.seed, reset.summary().episode) == (0, 9, 1), "it was reset once"
    assert substance(act.act(STATES[2])) == substance(expected.sessions[0].act(STATES[2]))
    with pytest.raises(SessionGone):
        close.summary()
    lines = [record.getMessage() for record in caplog.records if record.name == "ada_diffuser"]
    assert sum("was away for" in line for line in lines) == len(calls), "one line for each that had to wait"
    assert any("no answer yet" in line for line in lines) == (back_s > 2), "who waits for long is told for what"
    expected.close()
    callers.close()


@pytest.mark.parametrize("face", FACES)
@pytest.mark.parametrize("how", ["dead", "frozen", "frozen, and a call has less time"])
def test_every_verb_gives_up_when_its_budget_is_spent(server: Server, how: str, face: str) -> None:
    """`budget_s` counted from the failure of the first call on, so a call that hung took its whole timeout besides."""
    budget_s = 1.2
    timeout_s = 0.4 if "less time" in how else 30.0
    callers = Callers(f"{face}://{server.address}", RetryPolicy(budget_s=budget_s), timeout_s)
    kind: type[AdaError] = Unavailable if how == "dead" else DeadlineExceeded
    if how == "dead":
        server.kill()
    else:
        server.freeze()
    started = time.monotonic()
    for name, call in callers.call().items():
        error, ended = call.result(60)
        took_s = ended - started
        assert type(error) is kind, (name, error)
        assert 0.5 * budget_s < took_s < budget_s + 0.7, (name, took_s)
        if how == "dead":
            assert "times in" in str(error), "what was tried is told"
    callers.close()


@pytest.mark.parametrize("face", FACES)
def test_an_answer_given_before_the_end_is_given_again_after_it(server: Server, face: str) -> None:
    """It was committed, its answer was lost, the server died: the same step again gets the same bytes from the next server."""
    with Client(f"{face}://{server.address}") as client, client.open_session(seed=1, options=NOISY) as session:
        session.act(STATES[0])
        lost = pickle.loads(pickle.dumps(session)).act(STATES[1])
        server.kill()
        server.start()
        again = session.act(STATES[1])
        assert again.replayed and not lost.replayed
        assert (again.step, substance(again)) == (2, substance(lost))
        assert not session.act(STATES[2]).replayed


@pytest.mark.parametrize("face", FACES)
def test_a_farm_goes_on_through_kills(server: Server, face: str) -> None:
    """Batches between which, in which and right after which the server is killed, beside the same ones undisturbed."""
    with Client(f"{face}://{server.address}") as client, ThreadPoolExecutor(1) as thread:

        def batches(kills: dict[int, str]) -> list[list[bytes]]:
            sessions = [client.open_session(seed=seed, options=NOISY) for seed in range(6)]
            told = []
            for step, state in enumerate(STATES[:16]):
                states = state + np.linspace(-0.1, 0.1, len(sessions))[:, None]
                kill = kills.get(step)
                if kill == "in":
                    server.freeze()
                    answers = thread.submit(client.act_batch, sessions, states)
                    until(lambda: server.unread() >= 1)
                else:
                    answers = thread.submit(client.act_batch, sessions, states)
                    if kill == "after":
                        answers.result(30)
                if kill:
                    server.kill()
                    server.start()
                told.append([substance(answer) for answer in answers.result(30)])
            assert all(session.summary().committed_step == 16 for session in sessions)
            return told

        assert batches({2: "in", 5: "during", 9: "after", 12: "in"}) == batches({})


@pytest.mark.parametrize("face", FACES)
def test_a_server_that_is_told_to_end_is_waited_for(server: Server, face: str) -> None:
    """DRAINING, a refused connection, NOT_READY: whatever a planned restart says, acts go on behind it."""
    with Client(f"{face}://{server.address}") as client, ThreadPoolExecutor(1) as thread:
        straight, session = (client.open_session(seed=1, options=NOISY) for _ in range(2))
        expected = [substance(straight.act(state)) for state in STATES]

        def drive() -> list[bytes]:
            told = []
            for state in STATES:
                told.append(substance(session.act(state)))
                time.sleep(0.02)  # as a simulator would take
            return told

        driving = thread.submit(drive)
        until(lambda: session.committed_step >= 5)
        server.end()
        server.start()
        assert driving.result(60) == expected


@pytest.mark.parametrize("main", [rollout.main, evaluate.main], ids=["rollout", "evaluate"])
def test_the_runners_go_on_through_a_kill(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, main: Callable[..., int]
) -> None:
    """A run of a week ended with the first restart of the server."""
    asked, act = [0], episodes._act
    words = ["--env", "point-wind-s", "--url", server.address, "--episodes", "4", "--vector", "4", "--episode-steps", "60"]

    def act_and_kill(*arguments: Any) -> None:
        asked[0] += 1
        if asked[0] == 25:
            server.kill()
            threading.Timer(0.4, server.start).start()
        act(*arguments)

    returns = []
    for disturbed in (False, True):
        if disturbed:
            monkeypatch.setattr(episodes, "_act", act_and_kill)
        capsys.readouterr()
        assert main([*words, "--json", str(tmp_path / "told.json")]) == 0
        told = json.loads((tmp_path / "told.json").read_text())
        returns.append((told[0] if isinstance(told, list) else told)["returns"])
        lines = [line for line in capsys.readouterr().err.splitlines() if "away" in line]
        assert len(lines) == int(disturbed)
        if disturbed:
            assert lines[0].startswith(("ada-rollout: the server was away for ", "ada-evaluate: the server was away for "))
            assert 0.4 <= float(lines[0].partition(" for ")[2].split()[0]) < 5
    assert returns[0] == returns[1], "as if nothing had been"


@pytest.mark.parametrize("face", FACES)
def test_a_session_without_a_store_is_gone_and_says_what_to_do(
    forgetful: Server, face: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client(f"{face}://{forgetful.address}") as client:
        session, other = client.open_session(seed=1), client.open_session(seed=2)
        session.act(STATES[0])
        forgetful.kill()
        forgetful.start()
        with pytest.raises(SessionGone, match=r"(?s)^SESSION_NOT_FOUND: .*--store.*open a new session[^\n]*$"):
            session.act(STATES[1])
        (answer,) = client.act_batch([other], STATES[:1])
        assert isinstance(answer, SessionGone)
        for call in (session.summary, session.export, session.reset, session.fork, lambda: client.attach(session.session_id)):
            with pytest.raises(SessionGone):
                call()
        session.close()
        assert client.open_session(seed=1).act(STATES[0]).step == 1
    act = episodes._act

    def kill_and_act(*arguments: Any) -> None:
        monkeypatch.setattr(episodes, "_act", act)
        forgetful.kill()
        forgetful.start()
        act(*arguments)

    monkeypatch.setattr(episodes, "_act", kill_and_act)
    words = ["--env", "point-wind-s", "--url", forgetful.address, "--face", face, "--vector", "3", "--episodes", "3"]
    capsys.readouterr()
    assert rollout.main(words) == 1
    away, gone = capsys.readouterr().err.strip().splitlines()
    assert "was away" in away and gone.startswith("ada-rollout: SESSION_NOT_FOUND") and "open a new session" in gone


@pytest.mark.parametrize("face", FACES)
def test_a_checkpoint_that_is_gone_and_a_store_that_is_full_are_named(folder: Path, face: str) -> None:
    flags = ("--store", str(folder / "store"), "--set", "store.len_max=2")
    (server,) = [next(serving := _served(folder, *flags))]
    with Client(f"{face}://{server.address}") as client:
        session, other = client.open_session(seed=1), client.open_session(seed=2)
        with pytest.raises(StoreFull, match=r"STORE_FULL: .*make room") as caught:
            client.open_session(seed=3)
        assert not caught.value.retryable
        other.close()
        assert client.open_session(seed=3).act(STATES[0]).step == 1, "there is room again"
        session.act(STATES[0])
        server.kill()
        shutil.move(folder / "models/tiny", folder / "tiny")
        shutil.copytree(ROOT / "models/point-wind-s", folder / "models/tiny")
        server.start()
        with pytest.raises(ModelGone, match="serve that checkpoint again"):
            session.act(STATES[1])
        server.kill()
        shutil.rmtree(folder / "models/tiny")
        shutil.move(folder / "tiny", folder / "models/tiny")
        server.start()
        assert session.act(STATES[1]).step == 2, "and it goes on"
    serving.close()


@pytest.mark.parametrize("face", FACES)
def test_a_client_that_was_killed_itself_goes_on(server: Server, face: str) -> None:
    """It knows the session's id, how many answers it has, and what it was about to ask."""
    with Client(f"{face}://{server.address}") as client:
        session = client.open_session(seed=1, options=NOISY)
        chunks = [session.act(state) for state in STATES[:3]]
        kept = pickle.dumps(session)
        session_id = session.session_id
    server.kill()
    server.start()
    with Client(f"{face}://{server.address}") as client:
        again = client.attach(session_id, committed_step=2)
        lost = again.act(STATES[2])
        assert lost.replayed and substance(lost) == substance(chunks[2])
        assert client.attach(session_id).committed_step == client.attach(session_id, committed_step=3).committed_step == 3
        for wrong in (1, 4):
            with pytest.raises(StepConflict, match="STEP_OUT_OF_ORDER: committed_step: ") as caught:
                client.attach(session_id, committed_step=wrong)
            assert caught.value.committed_step == 3
        assert again.act(STATES[3]).step == 4
        assert pickle.loads(kept).act(STATES[3]).replayed


@pytest.mark.parametrize("face", FACES)
def test_who_leaves_because_the_server_is_away_does_not_wait_for_it_again(server: Server, face: str) -> None:
    """A farm of N sessions that gave up closed them one by one, each for as long as the budget."""
    with Client(f"{face}://{server.address}", retry=RetryPolicy(budget_s=0.5)) as client:
        with pytest.raises(Unavailable), ExitStack() as stack:
            sessions = [stack.enter_context(client.open_session()) for _ in range(20)]
            server.kill()
            started = time.monotonic()
            sessions[0].act(STATES[0])
        assert time.monotonic() - started < 2
        server.start()
        server.wait_ready()
        assert sessions[0].act(STATES[0]).step == 1, "and it is there still"
        with pytest.raises(KeyError), sessions[0]:
            raise KeyError("of the caller's own")
        with pytest.raises(SessionGone):
            sessions[0].summary()


def test_a_peer_that_is_silent_is_found_out_over_grpc(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that is gone says nothing: the call waited for all of its timeout, with gRPC's keepalive alone as well."""
    quick = {"grpc.keepalive_time_ms": 300, "grpc.keepalive_timeout_ms": 300, "grpc.http2.ping_timeout_ms": 300}
    assert quick.keys() <= dict(grpc_face._CHANNEL_OPTIONS).keys()
    monkeypatch.setattr(grpc_face, "_CHANNEL_OPTIONS", [*(dict(grpc_face._CHANNEL_OPTIONS) | quick).items()])
    with Client(f"grpc://{server.address}", retry=RetryPolicy(attempts=1)) as client, client.open_session() as session:
        server.freeze()
        started = time.monotonic()
        with pytest.raises(Unavailable):
            session.act(STATES[0])
        assert time.monotonic() - started < 5
        server.kill()
        server.start()
        server.wait_ready()


def test_a_peer_that_is_silent_is_found_out_by_the_kernel_over_rest(server: Server) -> None:
    import socket

    with Client(f"http://{server.address}") as client:
        client.models()
        (connection,) = client._face._idle  # type: ignore[attr-defined]
        assert connection.sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
        for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 1), ("TCP_USER_TIMEOUT", 15_000)):
            assert connection.sock.getsockopt(socket.IPPROTO_TCP, getattr(socket, name)) == value


def test_words_of_the_client_go_to_the_log(caplog: pytest.LogCaptureFixture, server: Server) -> None:
    """Nothing is said of a connection that stood again at once, nor where nothing was tried again."""
    with caplog.at_level(logging.INFO, "ada_diffuser"), Client(f"http://{server.address}") as client:
        client.models()
        server.kill()
        with Client(f"http://{server.address}", retry=RetryPolicy(attempts=1)) as once, pytest.raises(Unavailable):
            once.models()
        server.start()
        server.wait_ready()
        client.models()
    assert not [record for record in caplog.records if "away" in record.getMessage()]
