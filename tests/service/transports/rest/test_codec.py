"""JSON codec: protobuf's mapping in both directions, and robustness against any input."""

import math
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import hypothesis.strategies as st
import orjson
import pytest
from google.protobuf import json_format
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from hypothesis import given

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from service.errors import BadField
from service.transports.rest.codec import parse_json, to_dict, to_json

MESSAGES: list[type[Message]] = [
    pb.PredictRequest,
    pb.PredictResponse,
    models_pb.ListModelsResponse,
    models_pb.GetModelResponse,
]


def scalars(field: FieldDescriptor) -> "st.SearchStrategy[Any]":
    if field.enum_type is not None:
        return st.sampled_from([value.number for value in field.enum_type.values]) | st.integers(50, 60)
    kinds: dict[int, st.SearchStrategy[Any]] = {
        FieldDescriptor.TYPE_DOUBLE: st.floats(allow_nan=True, allow_infinity=True),
        FieldDescriptor.TYPE_BYTES: st.binary(max_size=5),
        FieldDescriptor.TYPE_STRING: st.text(max_size=5),
        FieldDescriptor.TYPE_BOOL: st.booleans(),
        FieldDescriptor.TYPE_UINT32: st.integers(0, 2**32 - 1),
    }
    return kinds[field.type]


@st.composite
def messages(draw: st.DrawFn, descriptor: Any) -> Message:
    """Generate any message of a type."""
    message = GetMessageClass(descriptor)()
    for field in descriptor.fields:
        if not draw(st.booleans()):
            continue
        inner = field.message_type
        if inner is not None and inner.GetOptions().map_entry:
            getattr(message, field.name).update(
                draw(st.dictionaries(st.text(max_size=3), st.floats(), max_size=3))
            )
        elif inner is not None:
            each = messages(inner)
            if field.is_repeated:
                getattr(message, field.name).extend(draw(st.lists(each, max_size=2)))
            else:
                getattr(message, field.name).CopyFrom(draw(each))
        elif field.is_repeated:
            getattr(message, field.name).extend(draw(st.lists(scalars(field), max_size=3)))
        else:
            setattr(message, field.name, draw(scalars(field)))
    return message


any_message = st.sampled_from(MESSAGES).flatmap(lambda kind: messages(kind.DESCRIPTOR))


def reference(message: Message) -> dict[str, Any]:
    return json_format.MessageToDict(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )


@given(any_message)
def test_written_as_protobuf_writes_it(message: Message) -> None:
    assert to_dict(message) == reference(message)


@given(any_message)
def test_what_is_written_can_be_read(message: Message) -> None:
    again = parse_json(type(message), to_json(message))
    assert reference(again) == reference(message)  # not the messages: NaN is not equal to itself


@given(any_message)
def test_pieces_are_the_whole(message: Message) -> None:
    assert to_json(message) == orjson.dumps(to_dict(message))


def test_agents_are_serialized_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    response = pb.PredictResponse()
    for index in range(20):
        response.forecasts.add(agent_id=f"a{index}", samples=[1.5] * 1000)
    sizes = []

    def dumps(value: object, **options: Any) -> bytes:
        text = orjson.dumps(value, **options)
        sizes.append(len(text))
        return text

    monkeypatch.setattr(
        "service.transports.rest.codec.orjson", SimpleNamespace(dumps=dumps, OPT_NON_STR_KEYS=4)
    )
    assert len(to_json(response)) > 20 * 4000
    assert max(sizes) < 2 * 4000


def test_both_spellings_are_read() -> None:
    snake = parse_json(pb.PredictRequest, b'{"scene_id": "s", "options": {"max_modes": 3}}')
    camel = parse_json(pb.PredictRequest, b'{"sceneId": "s", "options": {"maxModes": 3}}')
    assert snake == camel == pb.PredictRequest(scene_id="s", options=pb.PredictOptions(max_modes=3))


def test_defaults_are_written_and_absence_is_kept() -> None:
    written = to_dict(pb.AgentForecast(agent_id="a"))
    assert written["weights"] == []
    assert written["remaining_weight"] == 0.0
    assert written["status"] == "FORECAST_STATUS_UNSPECIFIED"
    assert "model" not in written
    assert to_dict(pb.AgentState(x=0.0)) == {"x": 0.0}


def test_huge_sums_are_not_taken_for_infinities() -> None:
    message = pb.AgentForecast(means=[1e308, 1e308, -math.inf])
    assert to_dict(message)["means"] == [1e308, 1e308, "-Infinity"]
    assert to_dict(pb.AgentForecast(means=[1e308, 1e308]))["means"] == [1e308, 1e308]


@pytest.mark.parametrize(
    ("body", "field"),
    [
        (b"", "body"),
        (b"{", "body"),
        (b"[]", "body"),
        (b"null", "body"),
        (b"3", "body"),
        (b'"text"', "body"),
        (b"\xff\xfe", "body"),
        (b'{"time": NaN}', "time"),
        (b'{"time": 1e400}', "body"),
        (b'{"a":' * 3000 + b"1" + b"}" * 3000, "body"),
        (b'{"agents":' + b"[" * 500 + b"]" * 500 + b"}", "agents"),
        (b'{"nothing": 1}', "nothing"),
        (b'{"agents": [{"id": "a"}, {"colour": 1}]}', "agents[1].colour"),
        (b'{"agents": [{"states": [{"time": 1, "x": "east"}]}]}', "agents[0].states[0].x"),
        (b'{"agents": [{"type": "AGENT_TYPE_TRAM"}]}', "agents[0].type"),
        (b'{"agents": [{"type": [1]}]}', "agents.type"),
        (b'{"agents": [null]}', "agents[0]"),
        (b'{"agents": {"id": "a"}}', "agents"),
        (b'{"agents": 7}', "agents"),
        (b'{"time": {}}', "time"),
        (b'{"time": []}', "time"),
        (b'{"model": 7}', "model"),
        (b'{"options": {"seed": -1}}', "options.seed"),
        (b'{"options": {"seed": 1.5}}', "options.seed"),
        (b'{"options": {"seed": 99999999999999999999999}}', "options.seed"),
        (b'{"options": {"strict": "yes"}}', "options.strict"),
        (b'{"options": "none"}', "options"),
        (b'{"sceneRaster": {"image": {"packed_bits": 5}}}', "scene_raster.image.packed_bits"),
        (b'{"scene_raster": {"image": {"packedBits": "", "png": ""}}}', "scene_raster.image"),
    ],
)
def test_what_is_no_request_is_a_bad_field(body: bytes, field: str) -> None:
    with pytest.raises(BadField) as caught:
        parse_json(pb.PredictRequest, body)
    [fault] = caught.value.faults
    assert fault.field == field or fault.field.startswith(field + ".")
    assert fault.detail


names = st.sampled_from(
    sorted(
        {
            f.name
            for m in (pb.PredictRequest, pb.Agent, pb.AgentState, pb.PredictOptions)
            for f in m.DESCRIPTOR.fields
        }
    )
)
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3) | names, inner, max_size=4)
    ),
    max_leaves=12,
)


@given(st.dictionaries(names, json_values, max_size=5))
def test_any_json_is_a_request_or_a_bad_field(document: dict[str, Any]) -> None:
    with suppress(BadField):
        parse_json(pb.PredictRequest, orjson.dumps(document))


@given(st.binary(max_size=60))
def test_any_bytes_are_a_request_or_a_bad_field(body: bytes) -> None:
    with suppress(BadField):
        parse_json(pb.PredictRequest, body)
