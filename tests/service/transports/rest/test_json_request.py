"""Predict requests as JSON: size limits apply before parsing, and the result equals protobuf's."""

import functools
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import hypothesis.strategies as st
import orjson
import pytest
from google.protobuf import json_format
from hypothesis import given

from cab.forecast.v1 import prediction_service_pb2 as pb
from service.errors import BadField, TooLarge
from service.predict.request_reader import RequestLimits
from service.settings import Settings
from service.transports.rest.codec import parse_json, read_request
from tests.service.requests import add_agent, make_request
from tests.service.timing import cpu_seconds

LIMITS = RequestLimits(agents=3, states=5)
DEFAULT = RequestLimits.from_settings(Settings())
STATE_NAMES = [field.name for field in pb.AgentState.DESCRIPTOR.fields]


def document(agents: list[Any]) -> bytes:
    return orjson.dumps({"agents": agents})


@pytest.mark.parametrize("snake", [True, False])
def test_requests_are_read(snake: bool) -> None:
    request = make_request(3, samples=2)
    request.agents[0].states[0].velocity_x = request.agents[0].states[0].velocity_y = 1.5
    request.agents[1].states[2].x = float("nan")  # a text in JSON: these states are for ParseDict
    text = json_format.MessageToJson(request, preserving_proto_field_name=snake)
    read = read_request(pb.PredictRequest, text.encode(), DEFAULT)
    assert str(read) == str(request)  # not the messages: NaN is not equal to itself


def test_as_many_as_may_be() -> None:
    assert len(read_request(pb.PredictRequest, document([{}] * 3), LIMITS).agents) == 3
    [agent] = read_request(pb.PredictRequest, document([{"states": [{}] * 5}]), LIMITS).agents
    assert len(agent.states) == 5


@pytest.mark.parametrize(
    ("agents", "message"),
    [
        ([{}] * 4, "more than 3 agents"),
        ([None] * 4, "more than 3 agents"),
        ([{"states": [{}] * 6}], "more than 5 states"),
        ([{"states": [{}] * 3}] * 2, "more than 5 states"),
        ([{"states": [None] * 6}], "more than 5 states"),
        ([{"states": [{}] * 2000}], "more objects and lists than"),
        ([{"id": [[]] * 2000}], "more objects and lists than"),
        ([{"states": [{"x": [0] * 3000}]}], "more values than"),
    ],
)
def test_too_large(agents: list[Any], message: str) -> None:
    with pytest.raises(TooLarge, match=message):
        read_request(pb.PredictRequest, document(agents), LIMITS)


@pytest.mark.parametrize(
    "body",
    [
        b'{"agents":[' + b"{}," * 5_000_000 + b"{}]}",
        b'{"agents":[{"states":[' + b"{}," * 5_000_000 + b"{}]}]}",
        b'{"agents":[' + b"[]," * 5_000_000 + b"[]]}",
        b'{"agents":[{"states":[' + b"1," * 7_000_000 + b"1]}]}",
        b"[" * 16_000_000,
    ],
    ids=["agents", "states", "lists", "numbers", "depth"],
)
def test_what_is_too_large_costs_nothing(body: bytes) -> None:
    def read() -> None:
        with pytest.raises(TooLarge):
            read_request(pb.PredictRequest, body, DEFAULT)

    assert cpu_seconds(read) < 0.5  # some 0.02 s, the time to count brackets


def test_the_largest_request_takes_a_second_not_a_minute() -> None:
    request = pb.PredictRequest(time=1e9)
    for index in range(128):
        add_agent(request, f"a{index}", frames=256)
    text = json_format.MessageToJson(request, indent=None).encode()
    assert read_request(pb.PredictRequest, text, DEFAULT) == request
    seconds = cpu_seconds(lambda: read_request(pb.PredictRequest, text, DEFAULT))
    assert seconds < 0.6  # some 0.05 s; ParseDict takes ten times as long


def test_too_many_states_of_one_agent_are_read() -> None:
    limits = RequestLimits.from_settings(Settings(max_agents=2, max_states=5))
    assert (
        len(read_request(pb.PredictRequest, document([{"states": [{}] * 6}]), limits).agents[0].states) == 6
    )


@pytest.mark.parametrize(
    ("body", "field"),
    [
        (b"{", "body"),
        (b'{"agents": 7}', "agents"),
        (
            b'{"agents": [{"states": [{"x": 1}]}, {"states": [{"x": 1}, {"x": "east"}]}]}',
            "agents[1].states[1].x",
        ),
        (b'{"agents": [{"states": [{"x": 1}]}, {"states": [{"z": 1}]}]}', "agents[1].states[0].z"),
        (b'{"agents": [{"states": {"x": 1}}]}', "agents[0].states"),
        (b'{"agents": [{"states": [{"velocity_x": 1, "velocityX": 1}]}]}', "agents[0].states[0]"),
        (b'{"options": {"context": [' + b'"aaaaaaa",' * 200_000 + b"1]}}", "options.context"),
    ],
)
def test_what_is_no_request_is_a_bad_field(body: bytes, field: str) -> None:
    with pytest.raises(BadField) as caught:
        read_request(pb.PredictRequest, body, DEFAULT)
    [fault] = caught.value.faults
    assert fault.field == field or fault.field.startswith(field + ".")


numbers = st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False, allow_infinity=False)
values = numbers | st.none() | st.booleans() | st.sampled_from(["1.5", "NaN", "east", []])
states = st.dictionaries(st.sampled_from([*STATE_NAMES, "headingRate", "velocityX", "z"]), values, max_size=3)
plain = st.dictionaries(st.sampled_from([*STATE_NAMES, "headingRate"]), numbers, max_size=4)
agents = st.fixed_dictionaries(
    {}, optional={"id": st.text(max_size=2), "states": st.none() | st.lists(plain | states, max_size=3)}
)


def outcome(read: Callable[[bytes], pb.PredictRequest], body: bytes) -> object:
    """Return the request as text, because NaN is not equal to itself, or the faults."""
    try:
        return str(read(body))
    except BadField as error:
        return error.faults


@given(st.lists(agents | plain, max_size=3))
def test_plain_states_are_read_as_protobuf_reads_them(given_agents: list[dict[str, Any]]) -> None:
    body = document(given_agents)
    expected = outcome(functools.partial(parse_json, pb.PredictRequest), body)
    assert outcome(functools.partial(read_request, pb.PredictRequest, limits=DEFAULT), body) == expected


@given(st.binary(max_size=60))
def test_any_bytes_are_a_request_or_refused(body: bytes) -> None:
    with suppress(BadField, TooLarge):
        read_request(pb.PredictRequest, body, LIMITS)
