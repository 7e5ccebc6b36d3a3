"""Requests in wire form: what is too large is refused unread, all else is read as protobuf reads it."""

from contextlib import suppress

import hypothesis.strategies as st
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given

from cab.forecast.v1 import prediction_service_pb2 as pb
from service.errors import BadField, ServiceError, TooLarge
from service.predict.agents import read_agents
from service.predict.protobuf_request import read_request
from service.predict.request_limits import Sizes
from service.settings import Settings
from tests.service.requests import add_agent, make_request
from tests.service.timing import cpu_seconds

SIZES = Sizes(agents=3, states=5)
DEFAULT = Sizes.of(Settings())
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
    assert read_request(request.SerializeToString(), DEFAULT) == request
    assert read_request(b"", DEFAULT) == pb.PredictRequest()


def test_as_many_as_may_be() -> None:
    assert len(read_request(EMPTY_AGENT * 3, SIZES).agents) == 3
    agent = field(AGENT, EMPTY_STATE * 5)
    assert len(read_request(agent, SIZES).agents[0].states) == 5
    halves = field(AGENT, EMPTY_STATE * 2) + field(AGENT, EMPTY_STATE * 3)
    assert len(read_request(halves, SIZES).agents) == 2


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
        read_request(body, SIZES)


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
            read_request(body, DEFAULT)

    assert cpu_seconds(read) < 0.5  # some 0.1 s for a quarter of a million states, else nothing


def test_too_many_states_of_one_agent_cost_that_agent_only() -> None:
    request = make_request(1)
    add_agent(request, "long", frames=600)
    read = read_request(request.SerializeToString(), Sizes.of(Settings(max_agents=2, max_states=512)))
    agents = read_agents(read, Settings())
    assert {index: fault.detail for index, fault in agents.faults.items()} == {1: "has 600; at most 512"}


def test_fields_of_a_newer_client_are_let_through() -> None:
    newer = b"\xfa\x07\x03abc\xf1\x07" + bytes(8) + b"\xf5\x07" + bytes(4) + b"\xf8\x07\x96\x01"
    body = newer + field(AGENT, EMPTY_STATE + newer) + newer
    assert len(read_request(body, SIZES).agents[0].states) == 1


@pytest.mark.parametrize(
    "body", [b"\xff\xff\xff", b"\x22\x05a", b"\x26", b"\x22", b"\x80" * 11, b"\x0a\x01\xff"]
)
def test_no_request(body: bytes) -> None:
    with pytest.raises(BadField) as caught:
        read_request(body, SIZES)
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
            read_request(body, SIZES)
        return
    states = sum(len(agent.states) for agent in expected.agents)
    if len(expected.agents) > SIZES.agents or states > SIZES.states:
        with pytest.raises(TooLarge):
            read_request(body, SIZES)
    else:
        with suppress(TooLarge):  # groups count as more than they are
            assert read_request(body, SIZES) == expected


@given(st.binary(max_size=60))
def test_any_bytes_are_a_request_or_refused(body: bytes) -> None:
    with suppress(ServiceError):
        read_request(body, DEFAULT)
