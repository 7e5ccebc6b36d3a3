"""Keeps the track memory from holding up forecasts: a budget, a limit and a circuit breaker for its calls."""

import asyncio
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import structlog

from service.tracking.store.base import StoreError
from service.tracking.store.circuit_breaker import Circuit
from service.tracking.store.failures import Reason, reason_of, store_error

_log = structlog.get_logger(__name__)

_T = TypeVar("_T")

_ANSWERS = (Reason.OUT_OF_MEMORY, Reason.READONLY)
"""Redis refuses, but is well enough to do so at once: no reason to leave it alone."""
_LIMIT = 30.0
"""s after which a call is ended; its own timeouts do so long before, unless there is a bug."""
_PASSES = 4
"""Passes of the event loop from a reply's arrival to the end of the call."""


@dataclass
class _Attempt:
    """A call, until it is known how it went."""

    op: str
    probe: bool
    """Of the circuit."""
    deadline: float
    """On the event loop's clock."""
    settled: bool = False


class Guard:
    """Waits for calls only so long, and makes none while it seems hopeless.

    A call that is over its budget is not cancelled, which would cost it its connection: it goes on to its own
    end, and only nobody waits for it any more.
    """

    def __init__(
        self,
        observe: Callable[[str, float], None],
        failed: Callable[[str, str], None],
        *,
        max_outstanding: int = 64,
        failures: int = 3,
        pause_s: float = 0.25,
        max_pause_s: float = 2.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """
        Args:
            observe: told the operation and the s it took, of each call that was made, at its own end.
            failed: told the operation and the ``Reason`` of each call that failed or was not made.
            max_outstanding: calls at a time, with those that nobody waits for any more.
            failures: in a row after which no calls are made for a while.
            pause_s: s of the first such pause; if the call after it fails too, the next one is twice as long.
            max_pause_s: s of the longest.
            clock: s, for the pauses.
        """
        self._observe = observe
        self._failed = failed
        self._max_outstanding = max_outstanding
        self._circuit = Circuit(failures, pause_s, max_pause_s, clock)
        self._outstanding: set[asyncio.Task[Any]] = set()
        self._closed = False

    @property
    def outstanding(self) -> int:
        """Calls under way, with those that nobody waits for any more."""
        return len(self._outstanding)

    async def run(
        self,
        op: str,
        call: Callable[[], Awaitable[_T]],
        budget_s: float,
        late: Callable[[_T], None] | None = None,
        patience_s: float | None = None,
    ) -> _T:
        """What a call returns.

        Args:
            op: which operation it is, for the counts.
            call: makes the call, which ends by itself, be it after this has returned.
            budget_s: s that this waits.
            late: given what the call returns when nobody waits for it any more.
            patience_s: s that the caller has, if that may be less; that it runs out says nothing of Redis.

        Raises:
            StoreError: it failed, took too long or was not made.
        """
        self._admit(op)
        task = asyncio.create_task(self._call(op, call), name=f"track memory {op}")
        self._outstanding.add(task)
        task.add_done_callback(self._outstanding.discard)
        attempt = _Attempt(op, self._circuit.begin(), asyncio.get_running_loop().time() + budget_s)
        hurried = patience_s is not None and patience_s < budget_s
        try:
            await _wait(task, patience_s if hurried and patience_s is not None else budget_s)
        except asyncio.CancelledError:
            # Nobody is there to be told, but the circuit must hear of it: this may be the call that decides.
            self._abandon(attempt, task, late)
            raise
        if not task.done():
            if not hurried:
                self._settle(attempt, Reason.TIMEOUT)
            self._abandon(attempt, task, late)
            raise store_error(Reason.TIMEOUT)
        return self._result(attempt, task)

    async def close(self, wait_s: float = 0.0) -> None:
        """Ends the calls under way; no others are made.

        Args:
            wait_s: s that they may take to end by themselves.
        """
        self._closed = True
        tasks = tuple(self._outstanding)
        if tasks:
            _, rest = await asyncio.wait(tasks, timeout=wait_s)
            for task in rest:
                task.cancel()
            await asyncio.gather(*rest, return_exceptions=True)

    def _admit(self, op: str) -> None:
        """Whether a call may be made.

        Raises:
            StoreError: it may not.
        """
        if self._closed:
            reason = Reason.STOPPING
        elif not self._circuit.ready:
            reason = Reason.CIRCUIT_OPEN
        elif len(self._outstanding) >= self._max_outstanding:
            reason = Reason.SATURATED
        else:
            return
        self._failed(op, reason)
        raise store_error(reason)

    async def _call(self, op: str, call: Callable[[], Awaitable[_T]]) -> _T:
        started = time.perf_counter()
        try:
            async with asyncio.timeout(_LIMIT):
                return await call()
        except Exception as error:
            if reason_of(error) is Reason.OTHER and not isinstance(error, StoreError):
                _log.exception("track memory failed", op=op)
            raise
        finally:
            self._observe(op, time.perf_counter() - started)

    def _result(self, attempt: _Attempt, task: asyncio.Task[_T]) -> _T:
        """What an ended call returned.

        Raises:
            StoreError: it failed.
        """
        reason = _reason(task)
        self._settle(attempt, reason)
        if reason is None:
            return task.result()
        if task.cancelled():
            raise store_error(reason)
        error = task.exception()
        if isinstance(error, StoreError) or not isinstance(error, Exception):
            return task.result()  # raises it
        raise store_error(reason) from error

    def _abandon(self, attempt: _Attempt, task: asyncio.Task[_T], late: Callable[[_T], None] | None) -> None:
        """Leaves a call to itself."""

        def ended(task: asyncio.Task[_T]) -> None:
            reason = _reason(task)
            if asyncio.get_running_loop().time() > attempt.deadline:
                self._settle(attempt, Reason.TIMEOUT)
            else:
                self._settle(attempt, reason)
            if reason is None and late is not None:
                late(task.result())

        task.add_done_callback(ended)

    def _settle(self, attempt: _Attempt, reason: Reason | None) -> None:
        """Counts how a call went, once.

        Args:
            attempt: the call.
            reason: of its failure; None: it succeeded.
        """
        if attempt.settled:
            return
        attempt.settled = True
        self._circuit.end(attempt.probe, reason is None or reason in _ANSWERS)
        if reason is not None:
            self._failed(attempt.op, reason)


async def _wait(task: asyncio.Task[Any], budget_s: float) -> None:
    """Returns when the task has ended or the budget is used up, whichever is first; leaves the task alone."""
    await asyncio.wait((task,), timeout=budget_s)
    # Where something else kept the event loop busy, the time may be over though the reply has long been here.
    for _ in range(_PASSES):
        if task.done():
            return
        await asyncio.sleep(0)


def _reason(task: asyncio.Task[Any]) -> Reason | None:
    """Why an ended task failed; None: it did not."""
    if task.cancelled():
        return Reason.STOPPING
    error = task.exception()
    return None if error is None else reason_of(error)
