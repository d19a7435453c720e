"""A session: one episode after the other, on one model."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING
from uuid import uuid4

from numpy.typing import ArrayLike

from ada_diffuser.errors import DeadlineExceeded, InvalidInput, Unavailable
from ada_diffuser.messages import ActCall, Chunk, Executed, ForkCall, Model, Observation, SessionSummary, executed_values
from ada_diffuser.values import column, flag, matrix, vector, whole_if_given

if TYPE_CHECKING:
    from ada_diffuser.client import Client


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
        """Closes the session. After an error it waits for nobody: where its server is away a session is left, to `attach` to or expire."""
        if error is None:
            self.close()
        elif not self._closed and not isinstance(error, (Unavailable, DeadlineExceeded)):
            self._client._let_go(self.session_id)

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
            executed = rewarded(reward)
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
            deadline_ms=whole_if_given(deadline_ms, "deadline_ms", bits=32),
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

    def token(self) -> bytes:
        """The session as a sealed token, as it stands on the server: `Client.resume` goes on with it after a crash, with no store at all.

        Nobody can read or change it, but whoever has it can go on with the session, until it expires (`tokens.ttl_ms` of the server).
        `InvalidInput` where the server has no key.
        """
        return self._client._seal(self.session_id)

    def fork(self, seed: int | None = None, *, ttl_ms: int | None = None) -> Session:
        """Another session that goes on from here; this one goes on too.

        Without `seed` both have the same future, as long as they see the same; with it the noise from now on is another one: plans to
        compare, in a simulator that was copied. `StepConflict` where the server's session stands elsewhere.
        """
        seed, ttl_ms = whole_if_given(seed, "seed"), whole_if_given(ttl_ms, "ttl_ms")
        return self._client._fork(ForkCall(self.session_id, seed, ttl_ms, uuid4().hex, self._committed_step, self._episode))

    def close(self) -> None:
        """Ends the session on the server; a second close does nothing."""
        if not self._closed:
            self._client._close_session(self.session_id)
            self._closed = True


def rewarded(reward: ArrayLike | None) -> list[Executed]:
    """Steps of which the rewards are known: one number, or one for each."""
    return [] if reward is None else [Executed(reward=value) for value in column(reward, "observation.reward")]
