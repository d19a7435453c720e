"""The client: sessions on a server, over gRPC or REST, with retries that cannot take a step twice.

    with Client("grpc://127.0.0.1:7777") as client, client.open_session(seed=7) as session:
        chunk = session.act(state)

What is sent again: an act, a batch, a reset, a close or a question that failed as `Overloaded`, `DeadlineExceeded` or
`Unavailable`, after a wait (`RetryPolicy`). An act is sent again with the same step and the same bytes, so the server either
takes it once or answers as it did before (`Chunk.replayed`). If all attempts fail, the last error is raised and the
session stands where it stood: call `act` with the same observation again, whenever you like.

Processes: clients and sessions may be made before a fork, pickled and copied. A client has connections of its own in each
process; a session goes on in the other one from the step where it stood, and only one of the two may go on with it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from types import TracebackType
from typing import Any, TypeVar
from uuid import uuid4

from numpy.typing import ArrayLike, NDArray

from ada_diffuser.errors import AdaError, InvalidInput, NotFound, TooLarge, Unavailable
from ada_diffuser.faces import Face, connect
from ada_diffuser.messages import (
    ActCall,
    Chunk,
    Executed,
    ForkCall,
    Model,
    Observation,
    OpenCall,
    SamplerOptions,
    SessionSummary,
    executed_values,
)
from ada_diffuser.retry import Backoff, RetryPolicy
from ada_diffuser.values import column, flag, invalid, matrix, text, vector, whole

T = TypeVar("T")

#: Longer than anybody waits, and short enough for every clock below.
_TIMEOUT_S_MAX = 1e8


class Client:
    """A server. Safe to use from many threads and after a fork; a `Session` belongs to one thread of one process at a time.

    It pickles and copies as its settings: the copy has connections of its own.
    """

    def __init__(self, url: str, *, timeout_s: float = 30.0, retry: RetryPolicy | None = None) -> None:
        """`url` is `grpc://host:port` or `http://host:port`; `timeout_s` bounds each attempt of each call, alike on both faces.

        It is when this side hangs up: the server is not told to hurry, and an act never comes out coarser for it. That is what the
        `deadline_ms` of an act asks for.
        """
        self.url = url
        self._timeout_s = float(timeout_s)
        if not 0 < self._timeout_s <= _TIMEOUT_S_MAX:
            raise ValueError(f"timeout_s = {timeout_s} is no number of seconds above 0, up to {_TIMEOUT_S_MAX:g}")
        self._retry = retry or RetryPolicy()
        # Acts of a batch that the server takes; None: as many as there are, until it refuses.
        self._batch_len: int | None = None
        self._closed = False
        # By process: what was connected before a fork belongs to the parent. Here it is neither used nor closed.
        self._faces: dict[int, Face] = {os.getpid(): connect(url)}

    @property
    def _face(self) -> Face:
        """The connections of this process."""
        if self._closed:
            raise RuntimeError("this client was closed: make a new one")
        process = os.getpid()
        return self._faces.get(process) or self._faces.setdefault(process, connect(self.url))

    def _tried(self, call: Callable[[float], T], retryable: Callable[[AdaError], bool] = lambda error: error.retryable) -> T:
        return self._retry.run(call, self._timeout_s, retryable)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_faces": {}}

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections of this process. Sessions that are still open expire on the server."""
        self._closed = True
        face = self._faces.pop(os.getpid(), None)
        if face is not None:
            face.close()

    def wait_ready(self, timeout_s: float = 60.0) -> None:
        """Returns when the server answers with at least one model; Unavailable if it does not within `timeout_s`."""
        end = time.monotonic() + timeout_s
        while True:
            try:
                if self._face.models(min(self._timeout_s, 2.0)):
                    return
                last: AdaError = Unavailable(f"{self.url} has no model loaded")
            except AdaError as error:
                if not error.retryable:
                    raise
                last = error
            if time.monotonic() > end:
                raise last
            time.sleep(0.1)

    def models(self) -> list[Model]:
        """All loaded models, by name."""
        return self._tried(lambda timeout_s: self._face.models(timeout_s))

    def model(self, name: str | None = "") -> Model:
        """One model, `name` or `name@digest`; empty: the default one."""
        name = _model_name(name)
        return self._tried(lambda timeout_s: self._face.model(name, timeout_s))

    def open_session(
        self,
        model: str | None = "",
        *,
        seed: int | None = None,
        options: SamplerOptions | None = None,
        ttl_ms: int | None = None,
        history: Sequence[Executed] = (),
    ) -> Session:
        """A session at committed step 0. Without `seed` the server draws one (`session.seed`).

        `history` are steps that were recorded before it in the same hidden context, oldest first; the latent looks back on them as on an
        episode before (`reset(keep_history=True)`). None in them is unknown; `Executed()`, which tells nothing, is the border between two
        episodes. Refused where the model's `trained.sessions` is false, or nothing in it looks back so far.
        If an answer is lost on the way, the retry gets the session that the first attempt has opened.
        """
        name, seed, ttl_ms = _model_name(model), _whole_if_given(seed, "seed"), _whole_if_given(ttl_ms, "ttl_ms")
        call = OpenCall(name, seed, _options(options), ttl_ms, uuid4().hex, executed_values(history, "history"))
        summary, spec = self._tried(lambda timeout_s: self._face.open_session(call, timeout_s))
        return Session(self, summary, spec)

    def import_session(self, record: bytes, *, ttl_ms: int | None = None) -> Session:
        """A session that goes on from where an exported one stood (`Session.export`), here or on another server.

        Same observations, same chunks as there, that of its last act included; `catch_up` is not needed. The model has to be served, by
        whatever name; `ModelGone` where it is not.
        """
        if not isinstance(record, (bytes, bytearray, memoryview)):
            raise invalid("record", f"is no bytes, but a {type(record).__name__}")
        record, ttl_ms, request_id = bytes(record), _whole_if_given(ttl_ms, "ttl_ms"), uuid4().hex
        summary, spec = self._tried(lambda timeout_s: self._face.import_session(record, ttl_ms, request_id, timeout_s))
        return Session(self, summary, spec)

    def attach(self, session_id: str) -> Session:
        """A session that was opened elsewhere, or before this program was started again."""
        summary = self.summary(session_id)
        return Session(self, summary, self.model(f"{summary.model}@{summary.model_digest}"))

    def summary(self, session_id: str) -> SessionSummary:
        """The state of a session."""
        session_id = _session_id(session_id)
        return self._tried(lambda timeout_s: self._face.get_session(session_id, timeout_s))

    def sessions(self, model: str | None = "", page_size: int = 0) -> Iterator[SessionSummary]:
        """All sessions, page after page as they are consumed.

        A list is no right to use what it lists: it tells the ``handle`` of each session, and no ``session_id``.
        """
        name, size, token = _model_name(model), whole(page_size, "page_size", bits=32), ""
        while True:
            page, token = self._tried(
                lambda timeout_s, token=token: self._face.list_sessions(name, size, token, timeout_s)  # type: ignore[misc]
            )
            yield from page
            if not token:
                return

    def act_batch(
        self,
        acts: Sequence[tuple[Session, Observation | ArrayLike]] | Sequence[Session],
        states: Sequence[ArrayLike] | NDArray[Any] | None = None,
        *,
        rewards: Sequence[ArrayLike | None] | NDArray[Any] | None = None,
        deadline_ms: int | None = None,
        planned_states: bool = False,
    ) -> list[Chunk | AdaError]:
        """One act in each of many different sessions. Each has its own answer or error, in the order of `acts`.

        `acts` are pairs of a session and its observation, or its state where nothing else is to be told; or sessions alone, N of
        them, with `states` `(N, state_dim)` and `rewards`: of a session the number or numbers that `act` takes as `reward`, so
        `(N,)` or `(N, steps)`, None where none is known.

        More acts than the server takes in one call are sent in several; only those that failed in a retryable way are sent
        again. An act that is too large by itself has that as its error; what else concerns a call as a whole is raised, and then
        no session has moved on here: the same batch again gets the answers that were lost.
        """
        pairs = _pairs(acts, states, rewards)
        if len({session.session_id for session, _ in pairs}) != len(pairs):
            raise ValueError("a session stands twice in the batch: one act a session is in flight")
        calls = []
        for i, (session, observation) in enumerate(pairs):
            try:
                calls.append(session.next_call(observation, deadline_ms, planned_states))
            except InvalidInput as error:
                raise InvalidInput(replace(error.detail, field=f"acts[{i}].{error.field}")) from None
        results = self._batch_until_settled(calls)
        for (session, _), result in zip(pairs, results, strict=True):
            if isinstance(result, Chunk):
                session.commit(result)
        return results

    def _batch_until_settled(self, calls: Sequence[ActCall]) -> list[Chunk | AdaError]:
        settled: dict[int, Chunk | AdaError] = {}
        pending = list(range(len(calls)))
        backoff = Backoff(self._retry, self._timeout_s)
        while pending:
            settled.update(zip(pending, self._batch([calls[i] for i in pending], backoff), strict=True))
            failed = [(i, result) for i, result in settled.items() if isinstance(result, AdaError) and result.retryable]
            pending = [i for i, _ in failed]
            if pending and not backoff.wait(max(error.retry_after_ms or 0 for _, error in failed)):
                break
        return [settled[i] for i in range(len(calls))]

    def _batch(self, calls: Sequence[ActCall], backoff: Backoff) -> list[Chunk | AdaError]:
        """One attempt of each. No answer says how much the server takes, in acts or bytes: what it refuses is halved."""
        results: list[Chunk | AdaError] = []
        part_len = self._batch_len or len(calls)
        taken_len, refused = 0, False
        while len(results) < len(calls):
            part = calls[len(results) :][:part_len]
            try:
                results += self._face.act_batch(part, backoff.timeout_s())
                taken_len = max(taken_len, len(part))
            except TooLarge as error:
                refused = True
                if len(part) > 1:
                    part_len = len(part) // 2
                else:
                    results.append(error)
                    part_len = self._batch_len or len(calls)
            except AdaError as error:
                if not error.retryable:
                    raise
                results += [error] * len(part)
        if refused and taken_len:
            self._batch_len = taken_len
        return results

    def _act(self, call: ActCall) -> Chunk:
        return self._tried(lambda timeout_s: self._face.act(call, timeout_s))

    def _reset(self, session_id: str, seed: int | None, keep_history: bool, episode: int) -> SessionSummary:
        seed, keep_history, request_id = _whole_if_given(seed, "seed"), flag(keep_history, "keep_history"), uuid4().hex
        # An act that was given up here may still be in flight there, for a moment: worth the wait.
        return self._tried(
            lambda timeout_s: self._face.reset_session(session_id, seed, keep_history, request_id, episode, timeout_s),
            lambda error: error.retryable or error.reason == "SESSION_BUSY",
        )

    def _export(self, session_id: str) -> bytes:
        return self._tried(lambda timeout_s: self._face.export_session(session_id, timeout_s))

    def _fork(self, call: ForkCall) -> Session:
        summary, spec = self._tried(lambda timeout_s: self._face.fork_session(call, timeout_s))
        return Session(self, summary, spec)

    def _close_session(self, session_id: str) -> None:
        # Not found: a close whose answer was lost, or the session expired. It is closed either way.
        with suppress(NotFound):
            self._tried(lambda timeout_s: self._face.close_session(session_id, timeout_s))


def _pairs(
    acts: Sequence[tuple[Session, Observation | ArrayLike]] | Sequence[Session],
    states: Sequence[ArrayLike] | NDArray[Any] | None,
    rewards: Sequence[ArrayLike | None] | NDArray[Any] | None,
) -> list[tuple[Session, Observation]]:
    """What `Client.act_batch` was given, as sessions with their observations."""
    if states is None:
        if rewards is not None or any(isinstance(act, Session) for act in acts):
            raise ValueError("sessions alone, and rewards, need `states`; else each act is a pair of a session and its observation")
        pairs: Sequence[Any] = acts
        return [(session, seen if isinstance(seen, Observation) else Observation(seen)) for session, seen in pairs]
    for name, rows in (("states", states), ("rewards", rewards)):
        if rows is not None and len(rows) != len(acts):
            raise invalid(name, f"has {len(rows)} rows for {len(acts)} sessions")
    told = [None] * len(acts) if rewards is None else rewards
    sessions: Sequence[Any] = acts
    return [(session, Observation(state, _rewarded(reward))) for session, state, reward in zip(sessions, states, told, strict=True)]


def _rewarded(reward: ArrayLike | None) -> list[Executed]:
    """Steps of which the rewards are known: one number, or one for each."""
    return [] if reward is None else [Executed(reward=value) for value in column(reward, "observation.reward")]


def _model_name(name: str | None) -> str:
    return "" if name is None else text(name, "model")


def _session_id(session_id: str) -> str:
    if not text(session_id, "session_id"):
        raise invalid("session_id", "is empty")
    return session_id


def _options(options: SamplerOptions | None) -> SamplerOptions:
    if options is None:
        return SamplerOptions()
    if not isinstance(options, SamplerOptions):
        raise invalid("options", f"is no SamplerOptions, but a {type(options).__name__}")
    return options.checked()


def _whole_if_given(value: int | None, field: str, bits: int = 64) -> int | None:
    return None if value is None else whole(value, field, bits)


class Session:
    """One episode after the other, on one model. A context manager that closes the session.

    It pickles and copies as its id, its client's settings and the step where it stands; the copy goes on from there.
    """

    def __init__(self, client: Client, summary: SessionSummary, model: Model) -> None:
        """Made by `Client.open_session` and `Client.attach`."""
        self._client = client
        self.session_id = summary.session_id
        #: The model: dimensions, horizons, bounds of the actions.
        self.model = model
        #: Sampling options in force.
        self.options = summary.options
        #: Seed of the running episode.
        self.seed = summary.seed
        self._committed_step = summary.committed_step
        self._episode = summary.episode
        self._closed = False

    def __enter__(self) -> Session:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self.close()
        except AdaError:
            if error is None:
                raise

    @property
    def committed_step(self) -> int:
        """Acts of the running episode that this client has the answer of."""
        return self._committed_step

    def act(
        self,
        state: ArrayLike,
        executed: Sequence[Executed] = (),
        *,
        reward: ArrayLike | None = None,
        nothing_executed: bool = False,
        context: ArrayLike | None = None,
        deadline_ms: int | None = None,
        planned_states: bool = False,
    ) -> Chunk:
        """One observation in, one chunk of actions out.

        `state` is the current state, `(state_dim,)`. `executed` says what was executed since the last act; empty means the
        whole last chunk. `reward` is short for it when only rewards are to be told: one for each step executed since.
        `nothing_executed` plans anew in the place of the last act: none of its actions was executed, and no time has passed.
        `context` is what an oracle is told, `(steps, dim)`, see `Observation.context`.
        """
        if reward is not None:
            if len(executed):
                raise ValueError("rewards stand in `executed` when it is given")
            executed = _rewarded(reward)
        call = self.next_call(Observation(state, executed, nothing_executed, context), deadline_ms, planned_states)
        chunk = self._client._act(call)
        self.commit(chunk)
        return chunk

    def next_call(self, observation: Observation, deadline_ms: int | None = None, planned_states: bool = False) -> ActCall:
        """The act that comes next, as it is sent, each time it is sent."""
        return ActCall(
            session_id=self.session_id,
            step=self._committed_step + 1,
            episode=self._episode,
            state=vector(observation.state, "observation.state"),
            executed=executed_values(observation.executed, "observation.executed"),
            nothing_executed=flag(observation.nothing_executed, "observation.nothing_executed"),
            deadline_ms=_whole_if_given(deadline_ms, "deadline_ms", bits=32),
            want_planned_states=flag(planned_states, "want_planned_states"),
            context=None if observation.context is None else matrix(observation.context, "observation.context"),
        )

    def commit(self, chunk: Chunk) -> None:
        """Notes that the answer of the next act has arrived."""
        if chunk.session_id != self.session_id or chunk.step != self._committed_step + 1:
            raise InvalidInput(f"step {chunk.step} of {chunk.session_id} is not the next of {self.session_id}")
        self._committed_step = chunk.step

    def reset(self, seed: int | None = None, *, keep_history: bool = False) -> None:
        """A new episode: committed step 0 again. Without `seed` the server draws one.

        With `keep_history` the latent goes on looking back on the old episode, for a context that outlasts episodes; refused where the
        model's `trained.sessions` is false.
        """
        summary = self._client._reset(self.session_id, seed, keep_history, self._episode)
        self.seed, self._committed_step, self._episode = summary.seed, summary.committed_step, summary.episode

    def summary(self) -> SessionSummary:
        """The state of the session on the server."""
        return self._client.summary(self.session_id)

    def catch_up(self) -> int:
        """Takes over the server's episode and committed step, after a `StepConflict` or `PayloadMismatch`; returns the step."""
        summary = self.summary()
        self.seed, self._committed_step, self._episode = summary.seed, summary.committed_step, summary.episode
        return self._committed_step

    def export(self) -> bytes:
        """The session as bytes, as it stands on the server: to go on with it elsewhere, or later (`Client.import_session`).

        This one goes on too. The bytes tell what it has seen, so they are as private as that; they hold neither its id nor the model.
        """
        return self._client._export(self.session_id)

    def fork(self, seed: int | None = None, *, ttl_ms: int | None = None) -> Session:
        """Another session that goes on from here; this one goes on too.

        Without `seed` both have the same future, as long as they see the same; with it the noise from now on is another one: plans to
        compare, in a simulator that was copied. `StepConflict` where the server's session stands elsewhere.
        """
        seed, ttl_ms = _whole_if_given(seed, "seed"), _whole_if_given(ttl_ms, "ttl_ms")
        return self._client._fork(ForkCall(self.session_id, seed, ttl_ms, uuid4().hex, self._committed_step, self._episode))

    def close(self) -> None:
        """Ends the session on the server; a second close does nothing."""
        if not self._closed:
            self._client._close_session(self.session_id)
            self._closed = True
