"""Streams of events as transports need them: closed whatever happens, and with word of when nothing comes."""

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from typing import TypeVar

_T = TypeVar("_T")


@asynccontextmanager
async def closing(events: AsyncIterator[_T]) -> AsyncIterator[AsyncIterator[_T]]:
    """Closes an iterator, if it is one that can be, when this is left."""
    try:
        yield events
    finally:
        close = getattr(events, "aclose", None)
        if close is not None:
            await close()


async def paced(events: AsyncIterator[_T], pause: float) -> AsyncGenerator[_T | None]:
    """Events as they come, and None whenever none came for a while.

    Args:
        events: is closed when this ends or is closed, also while it is being waited for.
        pause: s to wait for an event.

    Raises:
        Exception: whatever ``events`` raises.
    """
    async with closing(events):
        pending: asyncio.Future[_T] | None = None
        try:
            while True:
                if pending is None:
                    pending = asyncio.ensure_future(anext(events))
                done, _ = await asyncio.wait({pending}, timeout=pause)
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
            if pending is not None:  # or the iterator, still running, would refuse to be closed
                pending.cancel()
                await asyncio.gather(pending, return_exceptions=True)
