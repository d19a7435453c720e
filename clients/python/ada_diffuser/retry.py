"""When to send the same request again, how long to wait before, and when to give up.

The server makes this safe (step protocol in `agent.proto`): the same step with the same observation is taken once and
answered as often as asked, also by a server that was started again on the store of one that was killed. So a retry never has
to know whether the first call arrived.

What is waited for is told to the logger `ada_diffuser`: a server that is still away after two seconds, and how long it was away
once it answers. Who sets up no logging has these lines on stderr.
"""

from __future__ import annotations

import logging
import math
import random
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

from ada_diffuser.errors import AdaError, Unavailable

T = TypeVar("T")

_LOG = logging.getLogger(__package__)

#: A call with less time than this is not worth its bytes.
_TIMEOUT_S_MIN = 0.001
#: What is kept of the budget for the last call, where a longer wait would use it up.
_LAST_CALL_S = 1.0
#: A connection that was cut and stands again so soon is no absence of the server.
_AWAY_S_MIN = 0.1
#: Who waits for so long wants to know for what.
_SILENT_S_MAX = 2.0


@dataclass(frozen=True)
class RetryPolicy:
    """Bounds of retrying: the budget in seconds, and the number of calls where it is given. `RetryPolicy(attempts=1)` never retries."""

    #: Calls in all, the first one included; None: as many as the budget has room for.
    attempts: int | None = None
    #: Wait before the second call; it doubles with each call.
    base_s: float = 0.05
    #: Longest wait that this client chooses itself while the server answers, as where it is overloaded.
    cap_s: float = 2.0
    #: Seconds from the beginning of the first call to the moment when the request is given up, whatever they go by with: connecting,
    #: a server that does not answer, waits of this client's choice or of the server's.
    budget_s: float = 60.0
    #: Longest wait that this client chooses itself while there is no server: so soon is it found once it is back.
    away_cap_s: float = 0.25

    def __post_init__(self) -> None:
        if self.attempts is not None and self.attempts < 1:
            raise ValueError(f"attempts = {self.attempts}: there is at least the first one")
        for name in ("base_s", "cap_s", "budget_s", "away_cap_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)} is no number of seconds")
        if self.budget_s == 0:
            raise ValueError("budget_s = 0 is no time for a first call: attempts=1 is what never retries")

    def run(self, call: Callable[[float], T], timeout_s: float, retryable: Callable[[AdaError], bool] = lambda error: error.retryable) -> T:
        """`call(its timeout in s)`, again while it fails in a way that `retryable` accepts and the bounds allow; else its last error."""
        backoff = Backoff(self, timeout_s)
        while True:
            try:
                answer = call(backoff.timeout_s())
            except AdaError as error:
                if not retryable(error):
                    if error.reason:
                        backoff.answered()
                    raise
                if not backoff.wait(error):
                    raise backoff.given_up(error) from None
            else:
                backoff.answered()
                return answer


class Backoff:
    """The waits of one request, and how long each of its calls may take. Its time begins when it is made."""

    def __init__(self, policy: RetryPolicy, timeout_s: float) -> None:
        self._policy = policy
        self._timeout_s = timeout_s
        self._failures = 0
        self._started = time.monotonic()
        self._end = self._started + policy.budget_s
        #: Whether the next call is the last one, as the budget ends with it.
        self._is_last = False
        self._away_since: float | None = None
        self._told = False

    def timeout_s(self) -> float:
        """The timeout of the next call: no more than what is left of the budget."""
        return min(self._timeout_s, max(self._end - time.monotonic(), _TIMEOUT_S_MIN))

    def wait(self, error: AdaError) -> bool:
        """Sleeps until the call that failed so is due again; False, at once, if there is to be none.

        The server's own wish is a lower bound; half of the wait is random, so that clients that failed together do not
        come back together. A wait that would use up the budget is cut short, for one last call.
        """
        now = time.monotonic()
        self._failures += 1
        self._note(error, now)
        left_s = self._end - now
        if self._is_last or self._failures == self._policy.attempts or left_s <= _TIMEOUT_S_MIN:
            return False
        wait_s = self._wait_s(error)
        latest_s = left_s - min(_LAST_CALL_S, wait_s, left_s / 2)
        self._is_last = wait_s > latest_s
        time.sleep(min(wait_s, latest_s))
        return True

    def _wait_s(self, error: AdaError) -> float:
        cap_s = self._policy.away_cap_s if isinstance(error, Unavailable) else self._policy.cap_s
        chosen_s = min(self._policy.base_s * 2 ** min(self._failures - 1, 30), cap_s)
        return chosen_s * random.uniform(0.5, 1.0) + (error.retry_after_ms or 0) / 1000

    def _note(self, error: AdaError, now: float) -> None:
        """An absence begins, or goes on; who waits for long is told once."""
        if not isinstance(error, Unavailable):
            return
        if self._away_since is None:
            self._away_since = now
        if now - self._away_since >= _SILENT_S_MAX and not self._told:
            self._told = True
            _LOG.warning("no answer yet, trying again for %.0f s more: %s", max(self._end - now, 0), error)

    def answered(self) -> None:
        """The server has answered, whatever it said: an absence is over."""
        away_s = 0.0 if self._away_since is None else time.monotonic() - self._away_since
        self._away_since = None
        if away_s >= _AWAY_S_MIN:
            _LOG.warning("the server was away for %.1f s, and answers again", away_s)

    def given_up(self, error: AdaError) -> AdaError:
        """The last error, with what was tried."""
        if self._failures < 2:
            return error
        took_s = time.monotonic() - self._started
        tried = f"tried {self._failures} times in {took_s:.1f} s"
        return type(error)(replace(error.detail, message=f"{error.message} ({tried})" if error.message else tried))
