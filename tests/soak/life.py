"""What clients do to a server, good and bad: each kind goes on in a thread of its own until it is told to stop."""

from __future__ import annotations

import json
import random
import socket
import threading
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from http.client import HTTPConnection
from typing import Any

import numpy as np

from ada_diffuser import AdaError, Client, Observation, SamplerOptions, Session

MODEL = "tiny"
#: A plan of it takes long enough for a deadline to cut.
SLOW = "cheetah-wind-s"
#: More than the server holds in memory, so that some are always in its store alone.
MANY = 300
#: Sessions that nobody closes end by themselves after this.
TTL_MS = 2_000


class Life:
    """Kinds of clients, and what they met."""

    def __init__(self, address: str, seed: int) -> None:
        self.address = address
        self.done: Counter[str] = Counter()
        #: What nobody had asked for.
        self.surprises: list[str] = []
        self._stop = threading.Event()
        kinds: list[Callable[[Client, random.Random], None]] = [
            self._lives,
            self._lives,
            self._lives,
            self._has_family,
            self._holds_many,
            self._leaves,
            self._is_hurried,
            self._is_wrong,
            self._hangs_up,
            self._comes_in_crowds,
            self._looks_on,
        ]
        self._threads = [threading.Thread(target=self._run, args=(kind, seed + i), daemon=True) for i, kind in enumerate(kinds)]

    def start(self) -> None:
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Returns when all are gone."""
        self._stop.set()
        for thread in self._threads:
            thread.join(60)
            if thread.is_alive():
                self.surprises.append("a client does not come back")

    def _run(self, kind: Callable[[Client, random.Random], None], seed: int) -> None:
        rng = random.Random(seed)
        # Every second one over HTTP.
        url = f"{'http' if seed % 2 else 'grpc'}://{self.address}"
        with Client(url) as client:
            while not self._stop.is_set():
                try:
                    kind(client, rng)
                    self.done[kind.__name__.removeprefix("_")] += 1
                except Exception as error:  # whatever it is, it is told, and the soak goes on
                    self.surprises.append(f"{kind.__name__}: {type(error).__name__}: {error}")
                    if len(self.surprises) > 100:
                        return
                    self._stop.wait(1.0)

    def _act(self, session: Session, rng: random.Random, **how: Any) -> None:
        width = session.model.state_dim
        session.act(np.array([rng.gauss(0, 0.3) for _ in range(width)], np.float32), **how)
        self.done["acts"] += 1

    def _lives(self, client: Client, rng: random.Random) -> None:
        """Opens, acts, resets, acts, closes."""
        options = SamplerOptions(temperature=1.0, latent="sample") if rng.random() < 0.5 else None
        with client.open_session(MODEL, options=options) as session:
            for episode in range(2):
                for _ in range(rng.randrange(40)):
                    self._act(session, rng, reward=rng.random())
                if episode == 0:
                    session.reset(keep_history=rng.random() < 0.5 and session.model.trained.sessions)

    def _has_family(self, client: Client, rng: random.Random) -> None:
        """Forks and imports."""
        with ExitStack() as stack:
            session = stack.enter_context(client.open_session(MODEL))
            for _ in range(3):
                self._act(session, rng)
                fork = stack.enter_context(session.fork(seed=rng.randrange(1 << 30)))
                self._act(fork, rng)
                self._act(stack.enter_context(client.import_session(fork.export())), rng)

    def _holds_many(self, client: Client, rng: random.Random) -> None:
        """More sessions than memory has room for, in no order."""
        with ExitStack() as stack:
            sessions = [stack.enter_context(client.open_session(MODEL, ttl_ms=600_000)) for _ in range(MANY)]
            for _ in range(4 * MANY):
                if self._stop.is_set():
                    return
                with suppress(AdaError):  # every place may be taken by those who are busy
                    self._act(rng.choice(sessions), rng)

    def _leaves(self, client: Client, rng: random.Random) -> None:
        """Lets its sessions expire."""
        for _ in range(5):
            session = client.open_session(MODEL, ttl_ms=TTL_MS)
            self._act(session, rng)
        self._stop.wait(0.2)

    def _is_hurried(self, client: Client, rng: random.Random) -> None:
        """Wants plans sooner than there can be any, and gives up."""
        with client.open_session(SLOW, options=SamplerOptions(streaming=False)) as session:
            for _ in range(20):
                with suppress(AdaError):
                    self._act(session, rng, deadline_ms=rng.randrange(1, 8))
                session.catch_up()

    def _is_wrong(self, client: Client, rng: random.Random) -> None:
        """Sends what cannot be, over JSON."""
        with client.open_session(MODEL) as session:
            path = f"/v1/sessions/{session.session_id}/act"
            state = [0.0] * session.model.state_dim
            for body in (
                b"{",
                b"[]",
                b'{"step": 1e99}',
                json.dumps({"step": 1, "observation": {"state": state[1:]}}).encode(),
                json.dumps({"step": 7, "observation": {"state": state}}).encode(),
                b'{"step": 1, "observation": {"state": ["NaN"]}}',
                b" " * (1 << 21),
            ):
                status = self._post(path, body)
                assert 400 <= status < 500, f"{status} for {body[:60]!r}"
            good = json.dumps({"step": 1, "observation": {"state": state}}).encode()
            status = self._post("/v1/sessions/00000000-0000-4000-8000-000000000000/act", good)
            assert status == 404, f"{status} for a session that never was"

    def _post(self, path: str, body: bytes) -> int:
        headers = {"content-type": "application/json"}
        request = urllib.request.Request(f"http://{self.address}{path}", body, headers, method="POST")
        try:
            return int(urllib.request.urlopen(request, timeout=30).status)
        except urllib.error.HTTPError as error:
            return error.code

    def _hangs_up(self, client: Client, rng: random.Random) -> None:
        """Asks, and is gone before the answer; or says half of it."""
        with client.open_session(SLOW, options=SamplerOptions(streaming=False)) as session:
            body = json.dumps({"step": 1, "observation": {"state": [0.0] * session.model.state_dim}})
            for whole in (True, True, False):
                connection = HTTPConnection(self.address, timeout=30)
                connection.connect()
                path = f"/v1/sessions/{session.session_id}/act"
                names = {"host": self.address, "content-type": "application/json", "content-length": len(body)}
                lines = [f"POST {path} HTTP/1.1", *(f"{name}: {value}" for name, value in names.items()), "", ""]
                head = "\r\n".join(lines)
                assert isinstance(connection.sock, socket.socket)
                connection.sock.sendall((head + body if whole else head + body[:9]).encode())
                self._stop.wait(rng.random() * 0.01)
                connection.close()

    def _comes_in_crowds(self, client: Client, rng: random.Random) -> None:
        """Acts of many sessions at once."""
        with ExitStack() as stack:
            sessions = [stack.enter_context(client.open_session(MODEL)) for _ in range(16)]
            for _ in range(10):
                state = np.array([rng.gauss(0, 0.3) for _ in range(sessions[0].model.state_dim)], np.float32)
                answers = client.act_batch([(session, Observation(state)) for session in sessions])
                self.done["acts"] += len(answers)

    def _looks_on(self, client: Client, rng: random.Random) -> None:
        """Lists, models, pages, metrics."""
        for count, _session in enumerate(client.sessions(page_size=50)):
            if count > 200:
                break
        client.models()
        for path in ("/livez", "/readyz?verbose", "/metrics", "/openapi.json"):
            urllib.request.urlopen(f"http://{self.address}{path}", timeout=30).read()
        self._stop.wait(0.5 + rng.random())
