"""Clients, sessions and answers in more than one process: after a fork, pickled, copied. Against the real server on the tiny model."""

from __future__ import annotations

import copy
import gc
import multiprocessing
import pickle
from typing import Any

import numpy as np
import pytest

from ada_diffuser import ChunkBroker, Client, NotFound, Session

WORKERS = 4
ROUNDS = 8


@pytest.fixture(params=["grpc", "http"])
def url(address: str, request: pytest.FixtureRequest) -> str:
    return f"{request.param}://{address}"


def acts(session: Session, count: int = 10) -> bytes:
    """The bytes of some actions from where the session stands."""
    first = session.committed_step
    return b"".join(session.act(np.full(4, step / 100)).actions.tobytes() for step in range(first, first + count))


def episode(client: Client, seed: int) -> tuple[int, bytes]:
    session = client.open_session(seed=seed)
    return session.seed, acts(session)


def work(client: Client, seed: int, answers: Any) -> None:
    try:
        answers.put((seed, episode(client, seed)))
        del client
        gc.collect()
    except Exception as error:
        answers.put((seed, f"{type(error).__name__}: {error}"))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
def test_workers_that_were_forked_get_their_own_answers(url: str) -> None:
    """A client at module level, then DataLoader workers: all of them wrote to the one REST connection that stood idle at the fork.
    They read each other's answers (one drove another's session, without an error), and over gRPC streams were removed."""
    fork = multiprocessing.get_context("fork")
    seeds = range(1, WORKERS + 1)
    with Client(url) as alone:
        wanted = {seed: episode(alone, seed) for seed in seeds}
    for _ in range(ROUNDS):
        with Client(url, timeout_s=10) as client:
            client.models()
            answers = fork.Queue()
            workers = [fork.Process(target=work, args=(client, seed, answers), daemon=True) for seed in seeds]
            for worker in workers:
                worker.start()
            found = dict(answers.get(timeout=60) for _ in workers)
            for worker in workers:
                worker.join(10)
            assert found == wanted
            assert episode(client, 1) == wanted[1], "the parent's connections outlive its children"


@pytest.mark.parametrize("again", [copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))], ids=["deepcopy", "pickle"])
def test_clients_and_sessions_go_on_elsewhere(url: str, again: Any) -> None:
    """Neither could be pickled or copied: the message was of a lock, a socket or a `__cinit__`."""
    with Client(url, timeout_s=7) as client:
        with client.open_session(seed=5) as session:
            straight = acts(session, 6)
        session = client.open_session(seed=5)
        before = acts(session, 3)
        other = again(session)
        assert (other.session_id, other.committed_step, other.seed) == (session.session_id, 3, 5)
        assert other.model.name == "tiny" and other.options == session.options
        assert before + acts(other, 3) == straight
        broker = ChunkBroker(other)
        broker.action(np.zeros(4))
        assert again(broker).session.session_id == session.session_id
        other.close()
        with pytest.raises(NotFound, match="restart"):
            session.act(np.zeros(4))
        twin = again(client)
        assert (twin.url, twin._timeout_s, twin._retry) == (client.url, 7, client._retry)
        twin.close()
        assert client.models(), "the copy has connections of its own"


def test_answers_and_what_was_asked_pickle(url: str) -> None:
    with Client(url) as client, client.open_session(seed=5) as session:
        chunk = session.act(np.zeros(4), planned_states=True)
        for thing in (chunk, session.model, session.summary(), session.options):
            assert type(pickle.loads(pickle.dumps(thing))) is type(thing)
        assert pickle.loads(pickle.dumps(chunk)).actions.tobytes() == chunk.actions.tobytes()


def test_a_closed_client_says_so(url: str) -> None:
    """Over REST a closed client went on, over gRPC the address was blamed. A copy of a closed client is closed."""
    client = Client(url)
    client.models()
    client.close()
    client.close()
    for closed in (client, pickle.loads(pickle.dumps(client))):
        with pytest.raises(RuntimeError, match="make a new one"):
            closed.models()
