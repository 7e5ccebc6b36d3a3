"""Bounds of what both transports take in at a time: calls, and bytes of their bodies.

Calls are refused before their body is read. Health checks, probes and metrics count for neither bound of
calls, so that they are answered however many calls there are; streams of events have a bound of their own
(``Settings.max_watchers``).
"""

from collections.abc import Iterator
from contextlib import contextmanager

from service.errors import Overloaded
from service.settings import Settings
from service.telemetry.metrics import Metrics

SMALL_BODY = 2**20
"""Bytes up to which a body may use the whole budget; larger ones leave a reserve for the others."""
_RETRY_AFTER = 1.0
"""Seconds."""


class Intake:
    """The calls in progress of one server, and the bytes of their bodies. Used on one event loop."""

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self._metrics = metrics
        self._max_calls = settings.max_concurrent_calls
        self._max_bytes = settings.max_intake_bytes
        self._max_large = settings.max_large_intake_bytes
        self.calls = 0
        """Number of calls in progress."""
        self.bytes = 0
        """Reserved bytes."""

    @contextmanager
    def call(self) -> Iterator[None]:
        """Count a call until its response has been sent.

        Raises:
            Overloaded: there are too many calls.
        """
        if self.calls >= self._max_calls:
            self._metrics.refused.labels("concurrency").inc()
            raise Overloaded(
                f"{self.calls} calls are in progress, and at most that many may be", _RETRY_AFTER
            )
        self.calls += 1
        try:
            yield
        finally:
            self.calls -= 1

    @contextmanager
    def body(self) -> Iterator["Body"]:
        """Return a body without bytes; its reservation ends with the block."""
        body = Body(self)
        try:
            yield body
        finally:
            body.resize(0)

    def resize(self, old: int, new: int) -> None:
        """Change the reservation of one body.

        Args:
            old: reserved bytes of the body.
            new: bytes to reserve for it instead.

        Raises:
            Overloaded: the budget of bytes is used up; the old reservation remains.
        """
        budget = self._max_bytes if new <= SMALL_BODY else self._max_large
        total = self.bytes - old + new
        if new > old and total > budget:
            self._metrics.refused.labels("bytes").inc()
            raise Overloaded(
                f"the bodies of the calls in progress have {self.bytes} bytes; this one has no room",
                _RETRY_AFTER,
            )
        self.bytes = total


class Body:
    """The reservation of one body."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self._size = 0

    def grow(self, size: int) -> None:
        """Reserve at least that many bytes in all.

        Raises:
            Overloaded: the budget of bytes is used up.
        """
        if size > self._size:
            self.resize(size)

    def resize(self, size: int) -> None:
        """Reserve exactly that many bytes.

        Raises:
            Overloaded: the budget of bytes is used up.
        """
        self._intake.resize(self._size, size)
        self._size = size
