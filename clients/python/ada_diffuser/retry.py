"""When to send the same request again, and how long to wait before.

The server makes this safe (step protocol in `agent.proto`): the same step with the same observation is taken once and
answered as often as asked. So a retry never has to know whether the first call arrived.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from ada_diffuser.errors import AdaError

T = TypeVar("T")


@dataclass(frozen=True)
class RetryPolicy:
    """Bounds of retrying. `RetryPolicy(attempts=1)` never does."""

    #: Calls in all, the first one included.
    attempts: int = 6
    #: Wait before the second call; it doubles with each call.
    base_s: float = 0.05
    #: Longest wait that this client chooses itself.
    cap_s: float = 2.0
    #: No wait may end later than this after the first call failed.
    budget_s: float = 30.0

    def run(self, call: Callable[[], T], retryable: Callable[[AdaError], bool] = lambda error: error.retryable) -> T:
        """`call()`, again while it fails in a way that `retryable` accepts and the bounds allow; else its last error."""
        backoff = Backoff(self)
        while True:
            try:
                return call()
            except AdaError as error:
                if not retryable(error) or not backoff.wait(error.retry_after_ms):
                    raise


class Backoff:
    """The waits of one request."""

    def __init__(self, policy: RetryPolicy) -> None:
        self._policy = policy
        self._failures = 0
        self._end: float | None = None

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
        if self._failures >= self._policy.attempts or now + wait_s > self._end:
            return False
        time.sleep(wait_s)
        return True
