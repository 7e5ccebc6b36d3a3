"""Delivery of frames within a process."""

import asyncio
from collections.abc import AsyncGenerator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import aclosing

import pytest
from google.protobuf.message import Message

from cab.forecast.v1 import scene_service_pb2 as pb
from service.scenes.fanout import MAX_WAITING, Event, FrameFanout, PublishedFrame, PublishedMap
from service.scenes.shared_message import SharedMessage
from service.telemetry.metrics import Metrics


@pytest.fixture
def threads() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(1) as made:
        yield made


@pytest.fixture
def metrics() -> Metrics:
    return Metrics()


@pytest.fixture
def fanout(threads: ThreadPoolExecutor, metrics: Metrics) -> FrameFanout:
    return FrameFanout(2**20, metrics, threads)


def frame(
    fanout: FrameFanout, time: float, shown: PublishedMap | None = None, shadow: bool = False, size: int = 100
) -> PublishedFrame:
    event = pb.WatchForecastsResponse(frame=pb.ForecastFrame(time=time, shadow=shadow))
    return PublishedFrame(shadow, SharedMessage(event, fanout.threads, size), shown)


def map_of(fanout: FrameFanout, digest: bytes) -> PublishedMap:
    event = pb.WatchForecastsResponse(map=pb.SceneMap(digest=digest))
    return PublishedMap(digest, SharedMessage(event, fanout.threads))


async def read(events: AsyncGenerator[Event, None]) -> pb.WatchForecastsResponse:
    event = await asyncio.wait_for(anext(events), 5)
    message = event.message if isinstance(event, SharedMessage) else event
    assert isinstance(message, pb.WatchForecastsResponse)
    return message


async def test_a_map_comes_once_before_the_first_frame_that_has_it(fanout: FrameFanout) -> None:
    first, second = map_of(fanout, b"1"), map_of(fanout, b"2")
    async with aclosing(fanout.watch("s")) as events:
        assert await read(events) == pb.WatchForecastsResponse()
        for time, shown in ((1.0, first), (2.0, first), (3.0, second)):
            fanout.publish("s", frame(fanout, time, shown))
        got = [await read(events) for _ in range(5)]
    assert [one.WhichOneof("event") for one in got] == ["map", "frame", "frame", "map", "frame"]
    assert [one.map.digest for one in got if one.HasField("map")] == [b"1", b"2"]


async def test_a_slow_watcher_loses_the_oldest_and_is_told(fanout: FrameFanout, metrics: Metrics) -> None:
    async with aclosing(fanout.watch("s")) as slow, aclosing(fanout.watch("s")) as fast:
        for events in (slow, fast):
            await read(events)
        for time in range(MAX_WAITING + 3):
            fanout.publish("s", frame(fanout, time))
            assert (await read(fast)).frame.time == time
        assert (await read(slow)).dropped == 3
        assert [(await read(slow)).frame.time for _ in range(2)] == [3.0, 4.0]
    assert metrics.registry.get_sample_value("forecast_frames_dropped_total", {"reason": "watcher"}) == 3


async def test_waiting_frames_have_a_budget_of_bytes(threads: ThreadPoolExecutor, metrics: Metrics) -> None:
    fanout = FrameFanout(1000, metrics, threads)
    async with aclosing(fanout.watch("s")) as events:
        await read(events)
        for time in range(4):
            fanout.publish("s", frame(fanout, time, size=100))  # four times as much in memory
        assert (await read(events)).dropped == 2
        fanout.publish("s", frame(fanout, 9.0, size=10**6))  # one may always wait
        assert (await read(events)).frame.time in {2.0, 9.0}


async def test_who_comes_later_sees_the_newest_of_both_models_at_once(fanout: FrameFanout) -> None:
    async with aclosing(fanout.watch("s")) as first:
        await read(first)
        for time, shadow in ((1.0, False), (1.0, True), (2.0, False)):
            fanout.publish("s", frame(fanout, time, shadow=shadow))
        async with aclosing(fanout.watch("s")) as second:
            await read(second)
            got = [(await read(second)).frame for _ in range(2)]
    assert {(one.time, one.shadow) for one in got} == {(2.0, False), (1.0, True)}


async def test_nothing_is_left_of_a_scene_that_nobody_watches(fanout: FrameFanout) -> None:
    async with aclosing(fanout.watch("s")) as events:
        await read(events)
        assert fanout.is_watched("s")
        assert not fanout.is_watched("t")
        fanout.publish("t", frame(fanout, 1.0))
    assert fanout.watched == frozenset()
    fanout.publish("s", frame(fanout, 1.0))


async def test_an_encoding_is_made_once_for_all(threads: ThreadPoolExecutor) -> None:
    made = []

    def encode(event: SharedMessage | Message) -> bytes:
        made.append(event)
        return b"x"

    shared = SharedMessage(pb.WatchForecastsResponse(dropped=1), threads)
    impatient = asyncio.create_task(shared.encoded(encode))
    await asyncio.sleep(0)
    impatient.cancel()
    assert await asyncio.gather(*(shared.encoded(encode) for _ in range(3))) == [b"x"] * 3
    assert made == [shared]
