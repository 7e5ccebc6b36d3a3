"""Time budget of a call, and the retry policy that draws on it."""

import math
import time
from collections.abc import Iterator, Mapping

from tenacity import RetryCallState, retry_base, stop_after_attempt, stop_before_delay
from tenacity.stop import stop_base
from tenacity.wait import wait_base, wait_exponential_jitter, wait_random

from cab_forecast.errors import DeadlineExceeded, ForecastError

_MIN_BACKOFF = 0.05
_MAX_BACKOFF = 2.0
_AT_ONCE = 0.2
"""Share of the timeout before its end from which on a missed deadline is the client's."""


class Budget(Mapping[str, float]):
    """Remaining time of a call, shared by its retries and by the phases of each attempt.

    As a mapping, every key holds the seconds that remain at the moment of the look-up. httpx reads its
    "timeout" extension (connect, write, read, pool) this way, so that the sum of the phases is bounded. With
    plain numbers each phase would be granted the whole timeout.
    """

    def __init__(self, timeout: float) -> None:
        """Start the clock.

        Args:
            timeout: seconds.

        Raises:
            ValueError: the timeout is not a positive, finite number.
        """
        if not (timeout > 0 and math.isfinite(timeout)):
            raise ValueError(f"timeout must be positive and finite, not {timeout}")
        self.timeout = timeout
        self._end = time.monotonic() + timeout

    def remaining(self) -> float:
        """Return the remaining seconds.

        Raises:
            DeadlineExceeded: none remain.
        """
        left = self._end - time.monotonic()
        if left <= 0:
            raise self.exceeded()
        return left

    def exceeded(self) -> DeadlineExceeded:
        """Return the error for a call that took longer, the same over both transports."""
        return DeadlineExceeded(f"no response within {self.timeout:g} s")

    def late(self, error: DeadlineExceeded) -> DeadlineExceeded:
        """Return the error for a call that missed a deadline, the same over both transports.

        Whether the server or the client notices first is chance. Only a deadline of the server's own, long
        before the client's, has the server's text.
        """
        if self._end - time.monotonic() > _AT_ONCE * self.timeout:
            return error
        late = self.exceeded()
        late.reason, late.request_id = error.reason, error.request_id
        return late

    def __getitem__(self, phase: str) -> float:
        return self.remaining()

    def __iter__(self) -> Iterator[str]:
        return iter(("connect", "read", "write", "pool"))

    def __len__(self) -> int:
        return 4


class StreamTimeouts(Mapping[str, float]):
    """httpx timeouts of a stream: the budget until it has started, then a fixed timeout for each read."""

    def __init__(self, budget: Budget, idle_timeout: float) -> None:
        """Create the timeouts of one stream.

        Args:
            budget: the time for the start of the stream.
            idle_timeout: seconds without a byte after which the connection counts as lost.
        """
        self._budget = budget
        self._idle_timeout = idle_timeout
        self.started = False

    def __getitem__(self, phase: str) -> float:
        return self._idle_timeout if self.started else self._budget[phase]

    def __iter__(self) -> Iterator[str]:
        return iter(self._budget)

    def __len__(self) -> int:
        return len(self._budget)


class _Backoff(wait_base):
    """Backoff by the server's retry-after, or exponential without one; both with jitter."""

    def __init__(self) -> None:
        self._exponential = wait_exponential_jitter(
            multiplier=_MIN_BACKOFF, max=_MAX_BACKOFF, jitter=_MIN_BACKOFF
        )
        self._jitter = wait_random(0, _MIN_BACKOFF)

    def __call__(self, retry_state: RetryCallState) -> float:
        error = retry_state.outcome.exception() if retry_state.outcome else None
        if isinstance(error, ForecastError) and error.retry_after is not None:
            return error.retry_after + self._jitter(retry_state)
        return self._exponential(retry_state)


class _RetryIfRetryable(retry_base):
    """Retry of transient errors: overload, a draining server, a lost connection."""

    def __call__(self, retry_state: RetryCallState) -> bool:
        error = retry_state.outcome.exception() if retry_state.outcome else None
        return isinstance(error, ForecastError) and error.retryable


WAIT: wait_base = _Backoff()
RETRY: retry_base = _RetryIfRetryable()


def stop_condition(retries: int, budget: Budget) -> stop_base:
    """Return the condition that ends the retries: their number, or a wait that would outlast the budget."""
    return stop_after_attempt(retries + 1) | stop_before_delay(budget.timeout)
