"""Streamed responses with idle ticks."""

import asyncio
from collections.abc import AsyncGenerator
from contextlib import aclosing

import pytest

from service.transports.streams import with_idle_ticks


class Source:
    """Source of events from a queue that records whether it was closed."""

    def __init__(self) -> None:
        self.queue: asyncio.Queue[int | Exception | None] = asyncio.Queue()
        self.closed = False

    async def events(self) -> AsyncGenerator[int]:
        try:
            while (event := await self.queue.get()) is not None:
                if isinstance(event, Exception):
                    raise event
                yield event
        finally:
            await asyncio.sleep(0)  # as one does that lets go of a connection
            self.closed = True


async def test_tells_of_silence_and_loses_nothing() -> None:
    source = Source()
    async with aclosing(with_idle_ticks(source.events(), 0.03)) as found:
        assert [await anext(found) for _ in range(3)] == [None] * 3
        for event in range(3):
            source.queue.put_nowait(event)
        assert [await anext(found) for _ in range(4)] == [0, 1, 2, None]
        source.queue.put_nowait(None)
        with pytest.raises(StopAsyncIteration):
            await anext(found)
    assert source.closed


async def test_raises_what_the_source_raises() -> None:
    source = Source()
    source.queue.put_nowait(KeyError("x"))
    with pytest.raises(KeyError):
        [_ async for _ in with_idle_ticks(source.events(), 1)]
    assert source.closed


async def test_closes_the_source_while_it_is_being_waited_for() -> None:
    source = Source()

    async def read() -> None:
        async with aclosing(with_idle_ticks(source.events(), 0.01)) as found:
            async for _ in found:
                pass

    reading = asyncio.create_task(read())
    await asyncio.sleep(0.05)
    reading.cancel()
    with pytest.raises(asyncio.CancelledError):
        await reading
    assert source.closed
    second = Source()
    async with aclosing(with_idle_ticks(second.events(), 0.01)) as found:
        assert await anext(found) is None
    assert second.closed
