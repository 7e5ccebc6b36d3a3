"""Guard of the calls to the track memory: time budget, concurrency limit and circuit breaker.

It keeps a slow or broken track memory from delaying forecasts.
"""

import asyncio
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import structlog

from service.tracking.store.base import StoreError
from service.tracking.store.failures import FailureReason, reason_of, store_error
from service.tracking.store.outage import Outage

_log = structlog.get_logger(__name__)

_T = TypeVar("_T")

_HEALTHY = (FailureReason.OUT_OF_MEMORY, FailureReason.READONLY)
"""Refusals that Redis sends at once; they do not open the circuit."""
_TASK_TIMEOUT = 30.0
"""Seconds after which a call is cancelled; unless there is a bug, its own timeouts come long before."""
_CHECK_SECONDS = 1.0
"""Seconds in which the store must answer when the server starts."""
_LOOP_PASSES = 4
"""Passes of the event loop between the arrival of a reply and the end of the call."""


class CircuitBreaker:
    """Circuit breaker: after several failures in a row, calls pause; then one probe decides.

    It never waits. Used on one event loop.
    """

    def __init__(self, failures: int, pause_s: float, max_pause_s: float, clock: Callable[[], float]) -> None:
        """
        Args:
            failures: failures in a row that open the circuit.
            pause_s: seconds of the first pause; each further one is twice as long.
            max_pause_s: seconds of the longest pause.
            clock: clock, s.
        """
        self._limit = failures
        self._first_pause = pause_s
        self._max_pause = max_pause_s
        self._clock = clock
        self._failures = 0
        self._pause = pause_s
        self._open_until: float | None = None
        self._probing = False

    @property
    def is_open(self) -> bool:
        """True from the failures that open the circuit to the success of a probe."""
        return self._open_until is not None

    @property
    def ready(self) -> bool:
        """True if a call may be made now."""
        return self._open_until is None or (not self._probing and self._clock() >= self._open_until)

    def begin(self) -> bool:
        """Begin a call, which ``ready`` has allowed, and return whether it is the probe."""
        self._probing = self._open_until is not None
        return self._probing

    def end(self, probe: bool, success: bool) -> None:
        """Record the end of a call.

        Args:
            probe: result of ``begin``.
            success: whether the call succeeded.
        """
        if probe:
            self._probing = False
            if success:
                self._open_until, self._failures, self._pause = None, 0, self._first_pause
            else:
                self._open(min(2 * self._pause, self._max_pause))
        elif self._open_until is None:  # a call from before the circuit opened decides nothing
            self._failures = 0 if success else self._failures + 1
            if self._failures >= self._limit:
                self._open(self._first_pause)

    def _open(self, pause_s: float) -> None:
        self._pause = pause_s
        self._open_until = self._clock() + pause_s


@dataclass
class _Attempt:
    """A call whose result is not recorded yet."""

    op: str
    probe: bool
    """True if the call is the probe of the circuit breaker."""
    deadline: float
    """On the event loop's clock, s."""
    recorded: bool = False


class Guard:
    """Limits how long callers wait for the store, and makes no calls while they would fail.

    A call over its budget is not cancelled, since that would cost its connection. It runs to its own end in
    the background.
    """

    def __init__(
        self,
        observe: Callable[[str, float], None],
        failed: Callable[[str, str], None],
        *,
        calls: str = "all",
        max_outstanding: int = 64,
        failures: int = 3,
        pause_s: float = 0.25,
        max_pause_s: float = 2.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            observe: called with the operation and the duration in seconds at the end of each call.
            failed: called with the operation and the ``FailureReason`` of each call that failed or was
                refused.
            calls: the kind of calls, for the log.
            max_outstanding: calls in progress at most, including those that nobody waits for.
            failures: failures in a row that open the circuit.
            pause_s: seconds of the circuit breaker's first pause; it doubles after each failed probe.
            max_pause_s: seconds of the longest pause.
            clock: clock of the circuit breaker, s.
        """
        self._observe = observe
        self._failed = failed
        self._max_outstanding = max_outstanding
        self._circuit = CircuitBreaker(failures, pause_s, max_pause_s, clock)
        self._outage = Outage(calls, failures)
        self._outstanding: set[asyncio.Task[Any]] = set()
        self._closed = False

    @property
    def outstanding(self) -> int:
        """Number of calls in progress, including those that nobody waits for."""
        return len(self._outstanding)

    async def run(
        self,
        op: str,
        call: Callable[[], Awaitable[_T]],
        budget_s: float,
        late: Callable[[_T], None] | None = None,
        time_left_s: float | None = None,
    ) -> _T:
        """Make a call and return its result.

        Args:
            op: operation, for the metrics.
            call: starts the call, which must end by itself and may outlast this method.
            budget_s: seconds to wait.
            late: called with the result of a call that ends after this method.
            time_left_s: seconds that the caller has left; if this is less than the budget and runs out, the
                circuit breaker does not count it as a failure.

        Raises:
            StoreError: the call failed, took too long or was refused.
        """
        self._admit(op)
        task = asyncio.create_task(self._call(op, call), name=f"track memory {op}")
        self._outstanding.add(task)
        task.add_done_callback(self._outstanding.discard)
        attempt = _Attempt(op, self._circuit.begin(), asyncio.get_running_loop().time() + budget_s)
        hurried = time_left_s is not None and time_left_s < budget_s
        try:
            await _wait(task, time_left_s if hurried and time_left_s is not None else budget_s)
        except asyncio.CancelledError:
            # The circuit breaker still needs the result: this call may be the probe
            self._abandon(attempt, task, late)
            raise
        if not task.done():
            if not hurried:
                self._record(attempt, FailureReason.TIMEOUT)
            self._abandon(attempt, task, late)
            raise store_error(FailureReason.TIMEOUT)
        return self._result(attempt, task)

    async def check(self, call: Callable[[], Awaitable[None]]) -> None:
        """Make a first call, and log at once if it fails."""
        self._outage.suspect()
        with suppress(StoreError):
            await self.run("ping", call, _CHECK_SECONDS)

    async def close(self, wait_s: float = 0.0) -> None:
        """Cancel the calls in progress and refuse new ones.

        Args:
            wait_s: seconds that the calls may take to end by themselves.
        """
        self._closed = True
        tasks = tuple(self._outstanding)
        if tasks:
            _, remaining = await asyncio.wait(tasks, timeout=wait_s)
            for task in remaining:
                task.cancel()
            await asyncio.gather(*remaining, return_exceptions=True)

    def _admit(self, op: str) -> None:
        """Refuse a call that may not be made now.

        Raises:
            StoreError: the call may not be made.
        """
        if self._closed:
            reason = FailureReason.STOPPING
        elif not self._circuit.ready:
            reason = FailureReason.CIRCUIT_OPEN
        elif len(self._outstanding) >= self._max_outstanding:
            reason = FailureReason.SATURATED
        else:
            return
        self._failed(op, reason)
        raise store_error(reason)

    async def _call(self, op: str, call: Callable[[], Awaitable[_T]]) -> _T:
        started = time.perf_counter()
        try:
            async with asyncio.timeout(_TASK_TIMEOUT):
                return await call()
        except Exception as error:
            if reason_of(error) is FailureReason.OTHER and not isinstance(error, StoreError):
                _log.exception("track memory failed", op=op)
            raise
        finally:
            self._observe(op, time.perf_counter() - started)

    def _result(self, attempt: _Attempt, task: asyncio.Task[_T]) -> _T:
        """Return the result of an ended call.

        Raises:
            StoreError: the call failed.
        """
        reason = _failure(task)
        self._record(attempt, reason)
        if reason is None:
            return task.result()
        if task.cancelled():
            raise store_error(reason)
        error = task.exception()
        if isinstance(error, StoreError) or not isinstance(error, Exception):
            return task.result()  # raises it
        raise store_error(reason) from error

    def _abandon(self, attempt: _Attempt, task: asyncio.Task[_T], late: Callable[[_T], None] | None) -> None:
        """Let a call run to its end in the background."""

        def on_done(task: asyncio.Task[_T]) -> None:
            reason = _failure(task)
            if asyncio.get_running_loop().time() > attempt.deadline:
                self._record(attempt, FailureReason.TIMEOUT)
            else:
                self._record(attempt, reason)
            if reason is None and late is not None:
                late(task.result())

        task.add_done_callback(on_done)

    def _record(self, attempt: _Attempt, reason: FailureReason | None) -> None:
        """Record the result of a call, once.

        Args:
            attempt: the call.
            reason: reason of the failure; None: the call succeeded.
        """
        if attempt.recorded:
            return
        attempt.recorded = True
        self._circuit.end(attempt.probe, reason is None or reason in _HEALTHY)
        if reason is not None:
            self._failed(attempt.op, reason)
            self._outage.failed(reason, circuit_open=self._circuit.is_open)
        elif not self._circuit.is_open:  # a call from before the circuit opened decides nothing
            self._outage.succeeded()


async def _wait(task: asyncio.Task[Any], budget_s: float) -> None:
    """Wait until the task has ended or the budget is used up; the task is not cancelled."""
    await asyncio.wait((task,), timeout=budget_s)
    # If something kept the event loop busy, the budget may be over although the reply arrived in time
    for _ in range(_LOOP_PASSES):
        if task.done():
            return
        await asyncio.sleep(0)


def _failure(task: asyncio.Task[Any]) -> FailureReason | None:
    """Return why an ended task failed; None: it succeeded."""
    if task.cancelled():
        return FailureReason.STOPPING
    error = task.exception()
    return None if error is None else reason_of(error)
