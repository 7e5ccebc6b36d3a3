"""Lifecycle of a server: starting, ready, draining, failed."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum

from service.errors import Unavailable


class Phase(StrEnum):
    """Phase of a server."""

    STARTING = "starting"
    READY = "ready"
    DRAINING = "draining"
    FAILED = "ending after a failure"


class Lifecycle:
    """Phase of one server, and the number of its calls in progress. Used on one event loop."""

    def __init__(self) -> None:
        self._phase = Phase.STARTING
        self._calls = 0
        self._idle = asyncio.Event()
        self._idle.set()
        self.failed = asyncio.Event()
        """Event that is set by ``fail``."""

    @property
    def phase(self) -> Phase:
        """Phase of the server."""
        return self._phase

    @property
    def calls(self) -> int:
        """Number of calls in progress."""
        return self._calls

    def set_ready(self) -> None:
        """Accept calls from now on, unless the server is draining already."""
        if self._phase is Phase.STARTING:
            self._phase = Phase.READY

    def refuse(self) -> None:
        """Accept no more calls."""
        if self._phase is not Phase.FAILED:
            self._phase = Phase.DRAINING

    def fail(self) -> None:
        """Accept no more calls: the server can answer none any more and must end."""
        self._phase = Phase.FAILED
        self.failed.set()

    def require_ready(self) -> None:
        """Refuse a call unless the server is ready.

        Raises:
            Unavailable: the server is starting, draining or failed.
        """
        if self._phase is not Phase.READY:
            raise Unavailable(f"the server is {self._phase.value}")

    @contextmanager
    def in_progress(self) -> Iterator[None]:
        """Count a call as in progress until the block ends; a drain waits for it."""
        self._calls += 1
        self._idle.clear()
        try:
            yield
        finally:
            self._calls -= 1
            if self._calls == 0:
                self._idle.set()

    async def wait_idle(self, seconds: float) -> bool:
        """Wait until no call is in progress.

        Args:
            seconds: timeout.

        Returns:
            False if calls are still in progress after the timeout.
        """
        try:
            async with asyncio.timeout(seconds):
                await self._idle.wait()
        except TimeoutError:
            pass
        return self._calls == 0
