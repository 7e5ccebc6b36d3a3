"""Reading requests: large ones one after the other, and none for those who have gone."""

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from cab.forecast.v1 import prediction_service_pb2 as pb
from service.errors import BadField, Overloaded
from service.predict.request_decoder import LARGE_BYTES, MAX_WAITING, Encoded, Reader

SMALL, LARGE = bytes(1000), bytes(LARGE_BYTES + 1)


class Parser:
    """Takes as long as the test wants."""

    def __init__(self) -> None:
        self.free = threading.Event()
        self.begun: list[int] = []
        self.threads: set[int] = set()

    def __call__(self, body: bytes) -> pb.PredictRequest:
        self.begun.append(len(body))
        self.threads.add(threading.get_ident())
        assert self.free.wait(10)
        return pb.PredictRequest(scene_id=str(len(body)))


@pytest.fixture
def parser() -> Iterator[Parser]:
    made = Parser()
    yield made
    made.free.set()


@pytest.fixture
def reader() -> Iterator[Reader]:
    with ThreadPoolExecutor(4) as threads:
        yield Reader(threads)


async def begun(parser: Parser, count: int) -> None:
    async with asyncio.timeout(10):
        while len(parser.begun) < count:  # noqa: ASYNC110 - no event tells
            await asyncio.sleep(0.005)


async def test_quick_ones_are_read_at_once(reader: Reader, parser: Parser) -> None:
    parser.free.set()
    await reader.read(Encoded(SMALL, parser, quick_bytes=len(SMALL)))
    assert parser.threads == {threading.get_ident()}
    await reader.read(Encoded(SMALL, parser, quick_bytes=len(SMALL) - 1))
    assert len(parser.threads) == 2


async def test_large_ones_take_turns_and_small_ones_pass(reader: Reader, parser: Parser) -> None:
    calls = [asyncio.create_task(reader.read(Encoded(body, parser))) for body in (LARGE, LARGE, SMALL, SMALL)]
    await begun(parser, 3)
    await asyncio.sleep(0.05)
    assert sorted(parser.begun) == [len(SMALL), len(SMALL), len(LARGE)]
    parser.free.set()
    read = await asyncio.gather(*calls)
    assert [request.scene_id for request in read] == [str(len(b)) for b in (LARGE, LARGE, SMALL, SMALL)]


async def test_a_turn_lasts_until_the_thread_is_through(reader: Reader, parser: Parser) -> None:
    gone = asyncio.create_task(reader.read(Encoded(LARGE, parser)))
    await begun(parser, 1)
    waiting = asyncio.create_task(reader.read(Encoded(LARGE, parser)))
    left = asyncio.create_task(reader.read(Encoded(LARGE, parser)))
    await asyncio.sleep(0.02)
    for call in (gone, left):
        call.cancel()
    await asyncio.gather(gone, left, return_exceptions=True)
    await asyncio.sleep(0.05)
    assert len(parser.begun) == 1  # nobody waits for it any more, and still it keeps the others off
    parser.free.set()
    await waiting
    assert len(parser.begun) == 2  # what was left before its turn is never read


async def test_what_fails_passes_the_turn_on(reader: Reader, parser: Parser) -> None:
    def refuse(_: bytes) -> pb.PredictRequest:
        raise BadField("body", "is none")

    parser.free.set()
    for _ in range(2):
        with pytest.raises(BadField):
            await reader.read(Encoded(LARGE, refuse))
    assert await reader.read(Encoded(LARGE, parser))


async def test_not_too_many_wait(reader: Reader, parser: Parser) -> None:
    calls = [asyncio.create_task(reader.read(Encoded(LARGE, parser))) for _ in range(MAX_WAITING + 1)]
    await begun(parser, 1)
    with pytest.raises(Overloaded) as caught:
        await reader.read(Encoded(LARGE, parser))
    assert caught.value.retry_after
    parser.free.set()
    await asyncio.gather(*calls)
    assert await reader.read(Encoded(LARGE, parser))
