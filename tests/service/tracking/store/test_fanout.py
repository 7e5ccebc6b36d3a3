"""Delivery of events within one process."""

import asyncio

from service.tracking.store.fanout import BACKLOG, Fanout


async def test_every_reader_gets_every_event() -> None:
    fanout = Fanout()
    readers = [fanout.watch("a"), fanout.watch("a"), fanout.watch("b")]
    assert not fanout.watched("a")
    for reader in readers:
        assert await anext(reader) == ((), 0)
    assert fanout.watched("a")
    fanout.publish("a", [b"1", b"2"])
    fanout.publish("b", [b"3"])
    assert [await anext(reader) for reader in readers] == [([b"1", b"2"], 0)] * 2 + [([b"3"], 0)]
    for reader in readers:
        await reader.aclose()
    assert not fanout.watched("a")
    assert not fanout.watched("b")


async def test_a_slow_reader_loses_the_oldest_and_is_told_how_many() -> None:
    fanout = Fanout()
    slow = fanout.watch("a")
    await anext(slow)
    events = [b"%d" % number for number in range(BACKLOG + 7)]
    for event in events:
        fanout.publish("a", [event])
    assert await anext(slow) == (events[7:], 7)
    fanout.publish("a", [b"next"])
    assert await anext(slow) == ([b"next"], 0)
    await slow.aclose()


async def test_closing_ends_readers_that_wait() -> None:
    fanout = Fanout()
    reader = fanout.watch("a")
    await anext(reader)
    waiting = asyncio.ensure_future(anext(reader, None))
    await asyncio.sleep(0)
    fanout.close()
    async with asyncio.timeout(10):
        assert await waiting is None
    assert not fanout.watched("a")
