"""Reading requests: in turns off the event loop; what is too large is refused before it is parsed."""

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import hypothesis.strategies as st
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given

from cab.forecast.v1 import prediction_service_pb2 as pb
from service.errors import BadField, Overloaded, ServiceError, TooLarge
from service.predict.request import read_agents
from service.predict.request_reader import (
    LARGE_BYTES,
    MAX_WAITING,
    EncodedRequest,
    RequestLimits,
    RequestReader,
    read_protobuf,
)
from service.settings import Settings
from tests.service.requests import add_agent, make_request
from tests.service.timing import cpu_seconds

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
def reader() -> Iterator[RequestReader]:
    with ThreadPoolExecutor(4) as threads:
        yield RequestReader(threads)


async def begun(parser: Parser, count: int) -> None:
    async with asyncio.timeout(10):
        while len(parser.begun) < count:  # noqa: ASYNC110 - no event tells
            await asyncio.sleep(0.005)


async def test_quick_ones_are_read_at_once(reader: RequestReader, parser: Parser) -> None:
    parser.free.set()
    await reader.read(EncodedRequest(SMALL, parser, inline_bytes=len(SMALL)))
    assert parser.threads == {threading.get_ident()}
    await reader.read(EncodedRequest(SMALL, parser, inline_bytes=len(SMALL) - 1))
    assert len(parser.threads) == 2


async def test_large_ones_take_turns_and_small_ones_pass(reader: RequestReader, parser: Parser) -> None:
    calls = [
        asyncio.create_task(reader.read(EncodedRequest(body, parser)))
        for body in (LARGE, LARGE, SMALL, SMALL)
    ]
    await begun(parser, 3)
    await asyncio.sleep(0.05)
    assert sorted(parser.begun) == [len(SMALL), len(SMALL), len(LARGE)]
    parser.free.set()
    read = await asyncio.gather(*calls)
    assert [request.scene_id for request in read] == [str(len(b)) for b in (LARGE, LARGE, SMALL, SMALL)]


async def test_a_turn_lasts_until_the_thread_is_through(reader: RequestReader, parser: Parser) -> None:
    gone = asyncio.create_task(reader.read(EncodedRequest(LARGE, parser)))
    await begun(parser, 1)
    waiting = asyncio.create_task(reader.read(EncodedRequest(LARGE, parser)))
    left = asyncio.create_task(reader.read(EncodedRequest(LARGE, parser)))
    await asyncio.sleep(0.02)
    for call in (gone, left):
        call.cancel()
    await asyncio.gather(gone, left, return_exceptions=True)
    await asyncio.sleep(0.05)
    assert len(parser.begun) == 1  # nobody waits for it any more, and still it keeps the others off
    parser.free.set()
    await waiting
    assert len(parser.begun) == 2  # what was left before its turn is never read


async def test_what_fails_passes_the_turn_on(reader: RequestReader, parser: Parser) -> None:
    def refuse(_: bytes) -> pb.PredictRequest:
        raise BadField("body", "is none")

    parser.free.set()
    for _ in range(2):
        with pytest.raises(BadField):
            await reader.read(EncodedRequest(LARGE, refuse))
    assert await reader.read(EncodedRequest(LARGE, parser))


async def test_not_too_many_wait(reader: RequestReader, parser: Parser) -> None:
    calls = [asyncio.create_task(reader.read(EncodedRequest(LARGE, parser))) for _ in range(MAX_WAITING + 1)]
    await begun(parser, 1)
    with pytest.raises(Overloaded) as caught:
        await reader.read(EncodedRequest(LARGE, parser))
    assert caught.value.retry_after
    parser.free.set()
    await asyncio.gather(*calls)
    assert await reader.read(EncodedRequest(LARGE, parser))


LIMITS = RequestLimits(agents=3, states=5)
DEFAULT = RequestLimits.from_settings(Settings())
MEBIBYTE = 2**20

AGENT, STATE = 0x22, 0x1A
EMPTY_AGENT, EMPTY_STATE = bytes([AGENT, 0]), bytes([STATE, 0])
EMPTY_GROUP = b"\x7b\x7c"  # field 15, opened and closed


def varint(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*encoded, value])


def field(tag: int, contents: bytes) -> bytes:
    return bytes([tag]) + varint(len(contents)) + contents


def test_requests_are_read() -> None:
    request = make_request(20, samples=3)
    request.agents[0].map_patch.image.packed_bits = bytes(3750)
    request.scene_raster.image.png = b"\x22\x00" * 3000  # looks like agents, and is none
    assert read_protobuf(pb.PredictRequest, request.SerializeToString(), DEFAULT) == request
    assert read_protobuf(pb.PredictRequest, b"", DEFAULT) == pb.PredictRequest()


def test_as_many_as_may_be() -> None:
    assert len(read_protobuf(pb.PredictRequest, EMPTY_AGENT * 3, LIMITS).agents) == 3
    agent = field(AGENT, EMPTY_STATE * 5)
    assert len(read_protobuf(pb.PredictRequest, agent, LIMITS).agents[0].states) == 5
    halves = field(AGENT, EMPTY_STATE * 2) + field(AGENT, EMPTY_STATE * 3)
    assert len(read_protobuf(pb.PredictRequest, halves, LIMITS).agents) == 2


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (EMPTY_AGENT * 4, "more than 3 agents"),
        (field(AGENT, EMPTY_STATE * 6), "more than 5 states"),
        (field(AGENT, EMPTY_STATE * 3) * 2, "more than 5 states"),
        (b"\xa2\x80\x00\x00" * 4, "more than 3 agents"),  # the tag longer than it need be
        (b"\x22\x80\x80\x00" * 4, "more than 3 agents"),  # the length
        (EMPTY_GROUP + EMPTY_AGENT * 4, "more than 3 agents"),
        (field(AGENT, EMPTY_GROUP + EMPTY_STATE * 6), "more than 5 states"),
        (b"\x78\x01" * 65, "more than 64 fields"),
        (field(AGENT, b"\x78\x01" * 65), "more than 64 fields"),
        (EMPTY_GROUP * 40, "more than 64 fields"),
    ],
)
def test_too_large(body: bytes, message: str) -> None:
    pb.PredictRequest.FromString(body)
    with pytest.raises(TooLarge, match=message):
        read_protobuf(pb.PredictRequest, body, LIMITS)


@pytest.mark.parametrize(
    "body",
    [
        EMPTY_AGENT * (8 * MEBIBYTE - 1),
        field(AGENT, EMPTY_STATE * (8 * MEBIBYTE - 3)),
        b"\x78\x01" * (8 * MEBIBYTE),
        field(AGENT, b"\x78\x01" * (8 * MEBIBYTE - 3)),
        EMPTY_GROUP * (8 * MEBIBYTE),
    ],
    ids=["agents", "states", "fields", "fields of an agent", "groups"],
)
def test_what_is_too_large_costs_nothing(body: bytes) -> None:
    def read() -> None:
        with pytest.raises(TooLarge):
            read_protobuf(pb.PredictRequest, body, DEFAULT)

    assert cpu_seconds(read) < 0.5  # some 0.1 s for a quarter of a million states, else nothing


def test_too_many_states_of_one_agent_cost_that_agent_only() -> None:
    request = make_request(1)
    add_agent(request, "long", frames=600)
    read = read_protobuf(
        pb.PredictRequest,
        request.SerializeToString(),
        RequestLimits.from_settings(Settings(max_agents=2, max_states=512)),
    )
    agents = read_agents(read, Settings())
    assert {index: fault.detail for index, fault in agents.faults.items()} == {1: "has 600; at most 512"}


def test_fields_of_a_newer_client_are_let_through() -> None:
    newer = b"\xfa\x07\x03abc\xf1\x07" + bytes(8) + b"\xf5\x07" + bytes(4) + b"\xf8\x07\x96\x01"
    body = newer + field(AGENT, EMPTY_STATE + newer) + newer
    assert len(read_protobuf(pb.PredictRequest, body, LIMITS).agents[0].states) == 1


@pytest.mark.parametrize(
    "body", [b"\xff\xff\xff", b"\x22\x05a", b"\x26", b"\x22", b"\x80" * 11, b"\x0a\x01\xff"]
)
def test_no_request(body: bytes) -> None:
    with pytest.raises(BadField) as caught:
        read_protobuf(pb.PredictRequest, body, LIMITS)
    assert caught.value.faults[0].field == "body"


pieces = st.sampled_from(
    [
        EMPTY_AGENT,
        EMPTY_STATE,
        field(AGENT, EMPTY_STATE),
        field(AGENT, EMPTY_STATE * 4),
        b"\xa2\x80\x00\x00",
        b"\xa2\x80\x80\x80\x10\x00",
        b"\x22\x82\x00\x1a\x00",
        EMPTY_GROUP,
        b"\x7b",
        b"\x7c",
        b"\x79" + bytes(8),
        b"\x7d" + bytes(4),
        b"\x78\xff\x01",
        b"\x11",
    ]
)


@given(st.lists(pieces | st.binary(max_size=4), max_size=12).map(b"".join))
def test_nothing_too_large_gets_through(body: bytes) -> None:
    try:
        expected = pb.PredictRequest.FromString(body)
    except DecodeError:
        with pytest.raises((BadField, TooLarge)):
            read_protobuf(pb.PredictRequest, body, LIMITS)
        return
    states = sum(len(agent.states) for agent in expected.agents)
    if len(expected.agents) > LIMITS.agents or states > LIMITS.states:
        with pytest.raises(TooLarge):
            read_protobuf(pb.PredictRequest, body, LIMITS)
    else:
        with suppress(TooLarge):  # groups count as more than they are
            assert read_protobuf(pb.PredictRequest, body, LIMITS) == expected


@given(st.binary(max_size=60))
def test_any_bytes_are_a_request_or_refused(body: bytes) -> None:
    with suppress(ServiceError):
        read_protobuf(pb.PredictRequest, body, DEFAULT)
