"""Helpers for streamed responses: iterators that are always closed, and idle detection."""

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from typing import TypeVar

from google.protobuf.message import Message

from service.scenes.shared_message import Encoder, SharedMessage

_T = TypeVar("_T")

Event = Message | SharedMessage
"""What a stream sends."""

HEARTBEAT = 15.0
"""Seconds without an event after which a heartbeat tells client and proxies that the stream is alive: a
comment over REST, an empty message over gRPC."""


@asynccontextmanager
async def closing(events: AsyncIterator[_T]) -> AsyncIterator[AsyncIterator[_T]]:
    """Close an iterator on exit, if it has ``aclose``."""
    try:
        yield events
    finally:
        close = getattr(events, "aclose", None)
        if close is not None:
            await close()


async def with_idle_ticks(events: AsyncIterator[_T], interval: float) -> AsyncGenerator[_T | None]:
    """Yield events as they arrive, and None whenever none arrived for one interval.

    Args:
        events: closed when this generator ends or is closed, even while an event is awaited.
        interval: seconds.

    Raises:
        Exception: whatever ``events`` raises.
    """
    async with closing(events):
        pending: asyncio.Future[_T] | None = None
        try:
            while True:
                if pending is None:
                    pending = asyncio.ensure_future(anext(events))
                done, _ = await asyncio.wait({pending}, timeout=interval)
                if not done:
                    yield None
                    continue
                try:
                    event = pending.result()
                except StopAsyncIteration:
                    return
                pending = None
                yield event
        finally:
            if pending is not None:  # a generator that is still running cannot be closed
                pending.cancel()
                await asyncio.gather(pending, return_exceptions=True)


async def encoded(event: Event, encode: Encoder) -> bytes:
    """Return an event as a transport sends it; an encoding that several streams send is made once."""
    return await event.encoded(encode) if isinstance(event, SharedMessage) else encode(event)
