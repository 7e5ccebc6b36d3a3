"""Log of outages of the track memory: one line when it is lost, one when it is back."""

import time

import structlog

from service.tracking.store.failures import FailureReason

_log = structlog.get_logger(__name__)


class Outage:
    """State of the track memory, as the calls of one kind find it."""

    def __init__(self, calls: str, failures: int) -> None:
        """
        Args:
            calls: the kind of calls, for the log.
            failures: failures in a row from which on the memory counts as lost.
        """
        self._calls = calls
        self._limit = failures
        self._failures = 0
        self._since: float | None = None

    def suspect(self) -> None:
        """Let the next failure count as many: nothing has ever answered."""
        self._failures = self._limit - 1

    def failed(self, reason: FailureReason, *, circuit_open: bool) -> None:
        """Record a failure, and log the first one that makes an outage.

        Args:
            reason: reason of the failure.
            circuit_open: whether calls pause now.
        """
        if reason is FailureReason.STOPPING:
            return
        self._failures += 1
        if self._since is None and (circuit_open or self._failures >= self._limit):
            self._since = time.monotonic()
            _log.warning(
                "track memory lost", calls=self._calls, reason=reason.value, circuit_open=circuit_open
            )

    def succeeded(self) -> None:
        """Record a success, and log the end of an outage."""
        self._failures = 0
        if self._since is not None:
            seconds = round(time.monotonic() - self._since, 3)
            self._since = None
            _log.warning("track memory back", calls=self._calls, seconds=seconds)
