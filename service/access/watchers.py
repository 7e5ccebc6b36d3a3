"""The streams of events of all callers: how many there may be, and their common end."""

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from typing import TypeVar

from service.errors import Overloaded
from service.telemetry.metrics import Metrics

_T = TypeVar("_T")
_RETRY = 5.0
"""Seconds until a client that was refused should try to watch again."""


class Watchers:
    """Streams of events, on all transports. Used on one event loop."""

    def __init__(self, max_watchers: int, metrics: Metrics) -> None:
        """
        Args:
            max_watchers: max number of streams.
            metrics: count those that are open and those that are refused.
        """
        self._max_watchers = max_watchers
        self._metrics = metrics
        self._open = 0
        self._ended = asyncio.Event()

    @asynccontextmanager
    async def watching(self, method: str) -> AsyncIterator[None]:
        """Count a stream until the block ends.

        Args:
            method: the contract's method, for metrics.

        Raises:
            Overloaded: there are too many streams.
        """
        if self._open >= self._max_watchers:
            self._metrics.refused.labels("watchers").inc()
            raise Overloaded(f"{self._open} calls watch already", _RETRY)
        self._open += 1
        gauge = self._metrics.watchers.labels(method)
        gauge.inc()
        try:
            yield
        finally:
            self._open -= 1
            gauge.dec()

    async def until_ended(self, events: AsyncGenerator[_T, None]) -> AsyncGenerator[_T, None]:
        """Yield events until there are no more or all streams are ended; the events are closed then.

        Raises:
            Exception: whatever ``events`` raises.
        """
        ended = asyncio.ensure_future(self._ended.wait())
        try:
            while not self._ended.is_set():
                following = asyncio.ensure_future(anext(events))
                try:
                    await asyncio.wait({following, ended}, return_when=asyncio.FIRST_COMPLETED)
                    if not following.done():
                        return
                    event = following.result()
                except StopAsyncIteration:
                    return
                finally:
                    following.cancel()
                    await asyncio.gather(following, return_exceptions=True)
                yield event
        finally:
            ended.cancel()
            await events.aclose()

    def end(self) -> None:
        """End all streams, and those that begin later at once."""
        self._ended.set()
