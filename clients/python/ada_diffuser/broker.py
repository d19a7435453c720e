"""One action a step out of chunks, and the report of what became of them.

broker = ChunkBroker(session)
for _ in range(200):
    action = broker.action(state)                       # acts only when the chunk is used up
    state, reward, *_ = env.step(action)
    broker.report(reward=reward)                        # told to the model at the next act
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ada_diffuser.messages import Chunk, Executed, Observation
from ada_diffuser.session import Session
from ada_diffuser.values import Floats, number, vector


class ChunkBroker:
    """Hands out the actions of a session's chunks one by one.

    An oracle (`session.model.context`) is told the true `context` with each observation.

    With many simulators in lockstep, call `due`, `observation` and `accept` around `Client.act_batch` instead of `action`:

        due = [(b, s) for b, s in zip(brokers, states) if b.due]
        chunks = client.act_batch([(b.session, b.observation(s)) for b, s in due])
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        #: The chunk that is being executed; None before the first act of an episode.
        self.chunk: Chunk | None = None
        self._next = 0
        self._executed: list[Executed] = []

    @property
    def due(self) -> bool:
        """Whether the next action needs an act."""
        return self.chunk is None or self._next >= len(self.chunk.actions)

    def action(self, state: ArrayLike, *, context: ArrayLike | None = None) -> Floats:
        """The action for this state, `(action_dim,)`; acts if it is due, and only then looks at `context`."""
        if self.due:
            seen = self.observation(state, context=context)
            self.accept(self.session.act(seen.state, seen.executed, nothing_executed=seen.nothing_executed, context=seen.context))
        return self.take(state)

    def observation(self, state: ArrayLike, *, context: ArrayLike | None = None) -> Observation:
        """What an act at this state has to tell."""
        return Observation(state, tuple(self._executed), self.chunk is not None and not self._executed, context)

    def accept(self, chunk: Chunk) -> None:
        """The answer of the act that was due."""
        self.chunk = chunk
        self._next = 0
        self._executed = []

    def take(self, state: ArrayLike) -> Floats:
        """The next action of the chunk, noted as executed in `state`."""
        if self.chunk is None or self.due:
            raise RuntimeError("the chunk is used up: an act is due")
        action: Floats = self.chunk.actions[self._next].copy()
        # The state of the first step is that of the act's own observation.
        seen = np.array(state, dtype=np.float32) if self._executed else None
        self._executed.append(Executed(seen, action))
        self._next += 1
        return action.copy()

    def report(self, *, reward: ArrayLike | None = None, action: ArrayLike | None = None) -> None:
        """What became of the action handed out last: its reward, and the action itself where another one was executed."""
        if not self._executed:
            raise RuntimeError("no action was handed out since the last act")
        last = self._executed[-1]
        done = last.action if action is None else vector(action, "action")
        self._executed[-1] = Executed(last.state, done, last.reward if reward is None else number(reward, "reward"))

    def replan(self) -> None:
        """Drops the rest of the chunk, or all of it: the next action comes from a new act, which is told what was executed."""
        if self.chunk is not None:
            self._next = len(self.chunk.actions)

    def reset(self, seed: int | None = None, *, keep_history: bool = False) -> None:
        """A new episode in the same session, see `Session.reset`. What was executed since the last act is not told any more."""
        self.session.reset(seed, keep_history=keep_history)
        self.chunk, self._next, self._executed = None, 0, []
