"""The client: sessions on a server, over gRPC or REST, with retries that cannot take a step twice.

    with Client("grpc://127.0.0.1:7777") as client, client.open_session(seed=7) as session:
        chunk = session.act(state)

What is sent again: every call that failed as `Overloaded`, `DeadlineExceeded` or `Unavailable`, so also one that finds no server or
one that is starting, until it is answered or `RetryPolicy.budget_s` is spent. An act is sent again with the same step and the same
bytes, so the server either takes it once or answers as it did before (`Chunk.replayed`), and one with a store does so after it was killed
and started again. When the budget is spent the last error is raised and the session stands where it stood: call `act` with the same
observation again, whenever you like.

Processes: clients and sessions may be made before a fork, pickled and copied. A client has connections of its own in each
process; a session goes on in the other one from the step where it stood, and only one of the two may go on with it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, TypeVar
from uuid import uuid4

from numpy.typing import ArrayLike, NDArray

from ada_diffuser.errors import AdaError, Detail, InvalidInput, NotFound, StepConflict, TooLarge, Unavailable
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
from ada_diffuser.session import Session, rewarded
from ada_diffuser.values import flag, invalid, text, whole, whole_if_given

T = TypeVar("T")

#: Longer than anybody waits, and short enough for every clock below.
_TIMEOUT_S_MAX = 1e8
#: Who leaves because of an error waits no longer for the end of its session.
_LET_GO_S = 1.0


class Client:
    """A server. Safe to use from many threads and after a fork; a `Session` belongs to one thread of one process at a time.

    It pickles and copies as its settings: the copy has connections of its own.
    """

    def __init__(self, url: str, *, timeout_s: float = 30.0, retry: RetryPolicy | None = None) -> None:
        """`url` is `grpc://host:port` or `http://host:port`; `timeout_s` bounds each attempt of each call, alike on both faces.

        It is when this side hangs up: the server is not told to hurry, and an act never comes out coarser for it. That is what the
        `deadline_ms` of an act asks for. All attempts of a call together take no longer than `retry.budget_s`.
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
        name, seed, ttl_ms = _model_name(model), whole_if_given(seed, "seed"), whole_if_given(ttl_ms, "ttl_ms")
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
        record, ttl_ms, request_id = bytes(record), whole_if_given(ttl_ms, "ttl_ms"), uuid4().hex
        summary, spec = self._tried(lambda timeout_s: self._face.import_session(record, ttl_ms, request_id, timeout_s))
        return Session(self, summary, spec)

    def resume(self, token: bytes) -> Session:
        """The session that a token was made of (`Session.token`), with its id, where it stood then: on any server that has the key.

        Where this server knows nothing of the session, or something older, it goes on from the token; where it knows the same, as it is.
        `TokenStale` where it knows more: then `attach`, for acts that were committed are not taken back. An act that was answered after
        the token was made is asked for again, and gets the same answer if it is told the same.
        """
        if not isinstance(token, (bytes, bytearray, memoryview)):
            raise invalid("token", f"is no bytes, but a {type(token).__name__}")
        token = bytes(token)
        summary, spec = self._tried(lambda timeout_s: self._face.resume_session(token, timeout_s))
        return Session(self, summary, spec)

    def attach(self, session_id: str, *, committed_step: int | None = None) -> Session:
        """A session that was opened elsewhere, or before this program was started again. It goes on from where it stands on the server.

        `committed_step` is for who may have lost the answer of its last act: how many answers of the running episode it has. Where that is
        one fewer than the server has committed, the next `act` asks for the lost one, and gets it (`Chunk.replayed`) if it is told the
        same as then. `StepConflict` where it is any other number.
        """
        known = whole_if_given(committed_step, "committed_step")
        summary = self.summary(session_id)
        if known is not None and known not in (summary.committed_step, summary.committed_step - 1):
            message = f"{known} answers are neither all of the session's {summary.committed_step} nor all but the last"
            raise StepConflict(Detail(message, "STEP_OUT_OF_ORDER", "committed_step", summary.committed_step))
        model = self.model(f"{summary.model}@{summary.model_digest}")
        return Session(self, summary if known is None else replace(summary, committed_step=known), model)

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
            if not pending:
                backoff.answered()
            elif not backoff.wait(max((error for _, error in failed), key=lambda error: error.retry_after_ms or 0)):
                settled.update((i, backoff.given_up(error)) for i, error in failed)
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
        seed, keep_history, request_id = whole_if_given(seed, "seed"), flag(keep_history, "keep_history"), uuid4().hex
        # An act that was given up here may still be in flight there, for a moment: worth the wait.
        return self._tried(
            lambda timeout_s: self._face.reset_session(session_id, seed, keep_history, request_id, episode, timeout_s),
            lambda error: error.retryable or error.reason == "SESSION_BUSY",
        )

    def _export(self, session_id: str) -> bytes:
        return self._tried(lambda timeout_s: self._face.export_session(session_id, timeout_s))

    def _seal(self, session_id: str) -> bytes:
        return self._tried(lambda timeout_s: self._face.seal_session(session_id, timeout_s))

    def _fork(self, call: ForkCall) -> Session:
        summary, spec = self._tried(lambda timeout_s: self._face.fork_session(call, timeout_s))
        return Session(self, summary, spec)

    def _close_session(self, session_id: str) -> None:
        # Not found: a close whose answer was lost, or the session expired. It is closed either way.
        with suppress(NotFound):
            self._tried(lambda timeout_s: self._face.close_session(session_id, timeout_s))

    def _let_go(self, session_id: str) -> None:
        """A close that nobody waits for: the session expires if it is not heard."""
        with suppress(AdaError):
            self._face.close_session(session_id, min(self._timeout_s, _LET_GO_S))


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
    return [(session, Observation(state, rewarded(reward))) for session, state, reward in zip(sessions, states, told, strict=True)]


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
