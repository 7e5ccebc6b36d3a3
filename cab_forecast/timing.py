"""The time a call may take, and the pauses between its attempts."""

import math
import time
from collections.abc import Iterator, Mapping

from tenacity import RetryCallState, retry_base, stop_after_attempt, stop_before_delay
from tenacity.stop import stop_base
from tenacity.wait import wait_base, wait_exponential_jitter, wait_random

from cab_forecast.errors import DeadlineExceeded, ForecastError

_FIRST_PAUSE = 0.05
_LONGEST_PAUSE = 2.0


class Budget(Mapping[str, float]):
    """What is left of a call's timeout; retries and the phases of an attempt all draw on it.

    As a mapping every key holds the seconds left at the moment it is looked up. That is what makes
    httpx's "timeout" extension (connect, write, read, pool) bound the sum of its phases: given plain
    numbers it would grant each phase the whole timeout.
    """

    def __init__(self, timeout: float) -> None:
        """Starts the clock.

        Args:
            timeout: s.

        Raises:
            ValueError: the timeout is not a positive, finite number.
        """
        if not (timeout > 0 and math.isfinite(timeout)):
            raise ValueError(f"timeout must be positive and finite, not {timeout}")
        self.timeout = timeout
        self._end = time.monotonic() + timeout

    def remaining(self) -> float:
        """s.

        Raises:
            DeadlineExceeded: nothing is left.
        """
        left = self._end - time.monotonic()
        if left <= 0:
            raise self.exceeded()
        return left

    def exceeded(self) -> DeadlineExceeded:
        """The error for a call that took longer."""
        return DeadlineExceeded(f"no answer within {self.timeout:g} s")

    def __getitem__(self, phase: str) -> float:
        return self.remaining()

    def __iter__(self) -> Iterator[str]:
        return iter(("connect", "read", "write", "pool"))

    def __len__(self) -> int:
        return 4


class StreamTimes(Mapping[str, float]):
    """What httpx may wait for a stream: the budget until it has begun, from then on so long for each read."""

    def __init__(self, budget: Budget, silence: float) -> None:
        """
        Args:
            budget: of beginning.
            silence: s without a byte from the server after which the connection is taken for lost.
        """
        self._budget = budget
        self._silence = silence
        self.begun = False

    def __getitem__(self, phase: str) -> float:
        return self._silence if self.begun else self._budget[phase]

    def __iter__(self) -> Iterator[str]:
        return iter(self._budget)

    def __len__(self) -> int:
        return len(self._budget)


class _WaitAsTold(wait_base):
    """Waits as long as the server asked for, and a little at random so that clients do not return as one;
    without its word an exponential back-off with jitter."""

    def __init__(self) -> None:
        self._own = wait_exponential_jitter(multiplier=_FIRST_PAUSE, max=_LONGEST_PAUSE, jitter=_FIRST_PAUSE)
        self._spread = wait_random(0, _FIRST_PAUSE)

    def __call__(self, retry_state: RetryCallState) -> float:
        error = retry_state.outcome.exception() if retry_state.outcome else None
        if isinstance(error, ForecastError) and error.retry_after is not None:
            return error.retry_after + self._spread(retry_state)
        return self._own(retry_state)


class _RetryIfRetryable(retry_base):
    """Retries what may succeed in a moment: overload, a draining server, a lost connection."""

    def __call__(self, retry_state: RetryCallState) -> bool:
        error = retry_state.outcome.exception() if retry_state.outcome else None
        return isinstance(error, ForecastError) and error.retryable


WAIT: wait_base = _WaitAsTold()
RETRY: retry_base = _RetryIfRetryable()


def stop(retries: int, budget: Budget) -> stop_base:
    """Ends the retries after so many, or earlier when the next pause would outlast the budget."""
    return stop_after_attempt(retries + 1) | stop_before_delay(budget.timeout)
