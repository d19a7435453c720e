"""When to send the same request again, and how long to wait before.

The server makes this safe (step protocol in `agent.proto`): the same step with the same observation is taken once and
answered as often as asked. So a retry never has to know whether the first call arrived.
"""

from __future__ import annotations

import math
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from ada_diffuser.errors import AdaError

T = TypeVar("T")

#: A call with less time than this is not worth its bytes.
_TIMEOUT_S_MIN = 0.001


@dataclass(frozen=True)
class RetryPolicy:
    """Bounds of retrying. `RetryPolicy(attempts=1)` never does.

    A request takes at most the timeout of one call (its first) plus `budget_s`.
    """

    #: Calls in all, the first one included.
    attempts: int = 6
    #: Wait before the second call; it doubles with each call.
    base_s: float = 0.05
    #: Longest wait that this client chooses itself.
    cap_s: float = 2.0
    #: Time from the failure of the first call to the end of the last one: waits, and the calls themselves.
    budget_s: float = 30.0

    def __post_init__(self) -> None:
        if self.attempts < 1:
            raise ValueError(f"attempts = {self.attempts}: there is at least the first one")
        for name in ("base_s", "cap_s", "budget_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)} is no number of seconds")

    def run(self, call: Callable[[float], T], timeout_s: float, retryable: Callable[[AdaError], bool] = lambda error: error.retryable) -> T:
        """`call(its timeout in s)`, again while it fails in a way that `retryable` accepts and the bounds allow; else its last error."""
        backoff = Backoff(self, timeout_s)
        while True:
            try:
                return call(backoff.timeout_s())
            except AdaError as error:
                if not retryable(error) or not backoff.wait(error.retry_after_ms):
                    raise


class Backoff:
    """The waits of one request, and how long each of its calls may take."""

    def __init__(self, policy: RetryPolicy, timeout_s: float) -> None:
        self._policy = policy
        self._timeout_s = timeout_s
        self._failures = 0
        self._end: float | None = None

    def timeout_s(self) -> float:
        """The timeout of the next call: a retry has no more than what is left of the budget."""
        if self._end is None:
            return self._timeout_s
        return min(self._timeout_s, max(self._end - time.monotonic(), _TIMEOUT_S_MIN))

    def wait(self, retry_after_ms: int | None) -> bool:
        """Sleeps until the next call is due; False, at once, if there is to be none.

        The server's own wish is a lower bound; half of the wait is random, so that clients that failed together do not
        come back together.
        """
        now = time.monotonic()
        self._end = now + self._policy.budget_s if self._end is None else self._end
        self._failures += 1
        wait_s = min(self._policy.base_s * 2 ** (self._failures - 1), self._policy.cap_s)
        wait_s = wait_s * random.uniform(0.5, 1.0) + (retry_after_ms or 0) / 1000
        if self._failures >= self._policy.attempts or now + wait_s + _TIMEOUT_S_MIN > self._end:
            return False
        time.sleep(wait_s)
        return True
