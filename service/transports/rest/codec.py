"""JSON codec of the contract's messages, by protobuf's JSON mapping.

Reading uses protobuf's ``ParseDict``: camelCase and snake_case names, numbers as strings, base64 bytes.
Predict requests are the exception. ``ParseDict`` takes ten microseconds per number, and a request has up to
a million of them, nearly all in states. States of plain numbers, which are the common case, are therefore
constructed directly, and ``ParseDict`` reads the rest of the request.

Writing does not use ``MessageToDict``, which is slow for the tens of thousands of numbers of a forecast.
Names are written in snake_case, and fields with default values are written too, so that readers find every
key.
"""

import base64
import functools
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import orjson
from google.protobuf import json_format
from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.message import Message
from starlette.datastructures import QueryParams

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.model_service_pb2 import AgentType
from service.errors import BadField, TooLarge
from service.predict.request import UNKNOWN_TYPE_NAME
from service.predict.request_reader import RequestLimits, SceneRequest

_M = TypeVar("_M", bound=Message)
_Encoder = Callable[[Any], Any]

_FIELD_IN_ERROR = re.compile(r"Failed to parse (\w+) field")
_PATH_IN_ERROR = re.compile(r' at "?\w+((?:\.\w+(?:\[\d+\])?)*)"?\.*$')
_UNKNOWN_IN_ERROR = re.compile(r'has no field named "(.{0,64}?)" at "\w+((?:\.\w+(?:\[\d+\])?)*)"', re.DOTALL)
_MAX_REASON = 200
"""Characters of a reason that are sent to the client."""
_MAX_TEXT = 4000
"""Characters of a ParseError's text that are searched."""

_AGENTS = pb.PredictRequest.DESCRIPTOR.fields_by_number[pb.PredictRequest.AGENTS_FIELD_NUMBER].name
_TYPE = pb.Agent.DESCRIPTOR.fields_by_number[pb.Agent.TYPE_FIELD_NUMBER].name
_TYPE_NAMES = frozenset(AgentType.keys())
_INTEGER = re.compile(r"[+-]?\d+")
_STATES = pb.Agent.DESCRIPTOR.fields_by_number[pb.Agent.STATES_FIELD_NUMBER].name
_STATE_FIELDS = {
    spelling: field.name
    for field in pb.AgentState.DESCRIPTOR.fields
    for spelling in (field.name, field.json_name)
}
_BRACKETS_PER_AGENT = 256
"""Objects and lists of an agent besides its states, plus brackets in its id."""
_VALUES_PER_AGENT = 512
"""Values of an agent besides those of its states, plus commas in its id."""
_VALUES_PER_STATE = len(pb.AgentState.DESCRIPTOR.fields)


def parse_json(message_type: type[_M], body: bytes) -> _M:
    """Parse a message from JSON.

    Raises:
        BadField: the body is not valid JSON or not a valid message; names the field if it is known.
    """
    return from_document(message_type, load_document(body))


def load_document(body: bytes) -> dict[str, Any]:
    """Parse a JSON object.

    Raises:
        BadField: the body is not a JSON object.
    """
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        place = _place_of_constant(body)
        if place:
            raise BadField(place, "must be a finite number; NaN and Infinity are not JSON") from error
        raise BadField("body", f"is not valid JSON: {error}") from error
    if not isinstance(document, dict):
        raise BadField("body", "must be a JSON object")
    return document


def from_document(message_type: type[_M], document: dict[str, Any]) -> _M:
    """Return the message that a JSON object describes.

    Raises:
        BadField: the object is not a valid message; names the field if it is known.
    """
    message = message_type()
    try:
        json_format.ParseDict(document, message)
    except json_format.ParseError as error:
        raise _fault(str(error)) from error
    except (ValueError, TypeError, AttributeError, KeyError, ArithmeticError, RecursionError) as error:
        # ParseDict does not check all types itself.
        raise BadField(
            "body", f"is not a valid {message_type.DESCRIPTOR.name}: a value has the wrong type"
        ) from error
    return message


def read_query(
    message_type: type[_M], parameters: QueryParams, in_path: Mapping[str, str] | None = None
) -> _M:
    """Return the message, of scalar fields, that the query of a URL describes.

    Args:
        message_type: the message.
        parameters: the query.
        in_path: fields that are in the path of the URL.

    Raises:
        BadField: a parameter is unknown, repeated or invalid; names it.
    """
    document: dict[str, str] = dict(in_path or {})
    for name, value in parameters.multi_items():
        if name in document:
            raise BadField(name, "is given more than once")
        document[name] = value
    return from_document(message_type, document)


def read_request(kind: type[SceneRequest], body: bytes, limits: RequestLimits) -> SceneRequest:
    """Parse a request about a scene from JSON.

    Args:
        kind: type of the request.
        body: the body.
        limits: the limits.

    Raises:
        TooLarge: the request has more agents or states than allowed.
        BadField: the body is not a valid request; names the field if it is known.
    """
    _check_body(body, limits)
    document = load_document(body)
    _check_document(document, limits)
    _mark_unknown_types(document)
    states = _pop_plain_states(document)
    request = from_document(kind, document)
    for index, plain in states.items():
        request.agents[index].states.extend(plain)
    return request


def to_json(message: Message) -> bytes:
    """Serialize a message to JSON.

    The messages of a list, such as the forecasts of a response, are serialized one by one: orjson holds the
    interpreter lock, for 0.2 s if it were to serialize a large response at once.
    """
    pieces: list[bytes] = []
    separator = b"{"
    fields: Sequence[Any] = message.DESCRIPTOR.fields  # typed differently by implementation
    for field, (name, has_presence, encode) in zip(fields, _fields(message.DESCRIPTOR), strict=True):
        if has_presence and not message.HasField(name):
            continue
        pieces += (separator, _dumps(name), b":")
        separator = b","
        if _is_message_list(field):
            pieces += _list_pieces(getattr(message, name))
        else:
            pieces.append(_dumps(encode(getattr(message, name))))
    pieces.append(b"}" if pieces else b"{}")
    return b"".join(pieces)


def to_dict(message: Message) -> dict[str, Any]:
    """Convert a message to JSON types.

    The result equals ``MessageToDict`` with ``preserving_proto_field_name`` and
    ``always_print_fields_with_no_presence``.
    """
    encoded: dict[str, Any] = {}
    for name, has_presence, encode in _fields(message.DESCRIPTOR):
        if not has_presence or message.HasField(name):
            encoded[name] = encode(getattr(message, name))
    return encoded


def _list_pieces(messages: Iterable[Message]) -> Iterator[bytes]:
    separator = b"["
    for message in messages:
        yield separator
        yield _dumps(to_dict(message))
        separator = b","
    yield b"]" if separator == b"," else b"[]"


def _dumps(value: object) -> bytes:
    return orjson.dumps(value, option=orjson.OPT_NON_STR_KEYS)


def _is_message_list(field: FieldDescriptor) -> bool:
    kind = field.message_type
    return bool(field.is_repeated and kind is not None and not kind.GetOptions().map_entry)


def _check_body(body: bytes, limits: RequestLimits) -> None:
    """Bound the memory of the parsed JSON, which can be twenty times the size of the text.

    Raises:
        TooLarge: the text has more objects or values than a request within the limits can have.
    """
    if body.count(b"{") + body.count(b"[") > limits.states + _BRACKETS_PER_AGENT * (limits.agents + 1):
        raise TooLarge(
            f"more objects and lists than {limits.agents} agents and {limits.states} states can have"
        )
    if body.count(b",") > limits.states * _VALUES_PER_STATE + _VALUES_PER_AGENT * (limits.agents + 1):
        raise TooLarge(f"more values than {limits.agents} agents and {limits.states} states can have")


def _check_document(document: dict[str, Any], limits: RequestLimits) -> None:
    agents = document.get(_AGENTS)
    if not isinstance(agents, list):
        return
    limits.check_agents(len(agents))
    states = [agent[_STATES] for agent in agents if isinstance(agent, dict) and _STATES in agent]
    limits.check_states(sum(len(each) for each in states if isinstance(each, list)))


def _place_of_constant(body: bytes) -> str:
    """Return the path of the first bare NaN or Infinity in JSON, valid otherwise; empty: there is none."""
    if b"NaN" not in body and b"Infinity" not in body:
        return ""
    constant = object()
    try:
        document = json.loads(body, parse_constant=lambda _: constant)
    except (ValueError, RecursionError):
        return ""
    left: list[tuple[str, Any]] = [("", document)]
    while left:
        path, value = left.pop()
        if value is constant:
            return _snake(path.lstrip("."))[:_MAX_REASON]
        # Backwards onto the stack, so that the first one is found first
        if isinstance(value, dict):
            left += [(f"{path}.{name}", each) for name, each in reversed(value.items())]
        elif isinstance(value, list):
            left += [(f"{path}[{at}]", value[at]) for at in range(len(value) - 1, -1, -1)]
    return ""


def _mark_unknown_types(document: dict[str, Any]) -> None:
    """Replace unknown names of agent types by a number: as over gRPC, they cost no forecast of others."""
    agents = document.get(_AGENTS)
    for agent in agents if isinstance(agents, list) else ():
        name = agent.get(_TYPE) if isinstance(agent, dict) else None
        if isinstance(name, str) and name not in _TYPE_NAMES and not _INTEGER.fullmatch(name):
            agent[_TYPE] = UNKNOWN_TYPE_NAME


def _pop_plain_states(document: dict[str, Any]) -> dict[int, list[pb.AgentState]]:
    """Remove the states of agents whose states are all plain; return them by index of the agent."""
    popped: dict[int, list[pb.AgentState]] = {}
    agents = document.get(_AGENTS)
    for index, agent in enumerate(agents if isinstance(agents, list) else ()):
        states = agent.get(_STATES) if isinstance(agent, dict) else None
        if not isinstance(states, list):
            continue
        plain = _plain_states(states)
        if plain is not None:
            del agent[_STATES]
            popped[index] = plain
    return popped


def _plain_states(states: list[Any]) -> list[pb.AgentState] | None:
    """Return the states; None if any of them is not plain numbers, which ``ParseDict`` reads or refuses."""
    plain = []
    for state in states:
        if not isinstance(state, dict):
            return None
        values: dict[str, float] = {}
        for spelling, value in state.items():
            name = _STATE_FIELDS.get(spelling)
            if (
                name is None or name in values or type(value) not in (float, int)
            ):  # not isinstance: a bool is an int
                return None
            values[name] = value
        plain.append(pb.AgentState(**values))
    return plain


def _fault(text: str) -> BadField:
    """Return the field and the reason that the text of a ParseError gives."""
    if len(text) > _MAX_TEXT:  # it may quote a value of megabytes
        text = text[: _MAX_TEXT // 2] + text[-_MAX_TEXT // 2 :]
    text = text.split("\n", 1)[0]
    unknown = _UNKNOWN_IN_ERROR.search(text)
    if unknown:
        return BadField(_snake(f"{unknown[2]}.{unknown[1]}".lstrip(".")), "no such field")
    path = _PATH_IN_ERROR.search(text)
    names = _FIELD_IN_ERROR.findall(text)
    places = path[1].strip(".").split(".") if path and path[1] else []
    field = _snake(".".join([*places, *names[len(places) :]])) or "body"
    reason = (text[: path.start()] if path else text).rpartition(" field: ")[2].rstrip(".")
    # Without a path the text comes from a Python exception inside ParseDict, which does not help a client.
    if path is None and not reason.startswith("Value out of range"):
        reason = "has the wrong type"
    return BadField(field, reason[:_MAX_REASON])


def _snake(path: str) -> str:
    return re.sub(r"(?<=[a-z0-9])([A-Z])", lambda match: f"_{match[1].lower()}", path)


@functools.cache
def _fields(descriptor: Descriptor) -> tuple[tuple[str, bool, _Encoder], ...]:
    """Return, for each field of a message: its name, whether it has presence, and its encoder."""
    return tuple((field.name, field.has_presence, _encoder(field)) for field in descriptor.fields)


def _encoder(field: FieldDescriptor) -> _Encoder:
    kind = field.message_type
    if kind is not None and kind.GetOptions().map_entry:
        return _map_encoder(kind.fields_by_name["value"])
    single = _single_encoder(field)
    if not field.is_repeated:
        return single
    if field.cpp_type in (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT):
        return functools.partial(_floats, single=single)
    if single is _same:
        return list
    return lambda values: [single(value) for value in values]


def _floats(values: Any, single: _Encoder) -> list[Any]:
    numbers = list(values)
    # A finite sum means that all are finite. An infinite one may also be an overflow: check each number.
    if single is _double and math.isfinite(sum(numbers)):
        return numbers
    return [single(number) for number in numbers]


def _map_encoder(value_field: FieldDescriptor) -> _Encoder:
    single = _single_encoder(value_field)
    return lambda entries: {str(key): single(value) for key, value in entries.items()}


def _single_encoder(field: FieldDescriptor) -> _Encoder:
    if field.message_type is not None:
        return to_dict
    if field.enum_type is not None:
        return functools.partial(_enum, names=_enum_names(field.enum_type))
    encoders: dict[int, _Encoder] = {
        FieldDescriptor.TYPE_DOUBLE: _double,
        FieldDescriptor.TYPE_BYTES: _bytes,
        FieldDescriptor.TYPE_UINT32: _same,
        FieldDescriptor.TYPE_INT32: _same,
        FieldDescriptor.TYPE_UINT64: str,
        FieldDescriptor.TYPE_INT64: str,
        FieldDescriptor.TYPE_STRING: _same,
        FieldDescriptor.TYPE_BOOL: _same,
    }
    return encoders[field.type]


def _enum_names(kind: EnumDescriptor) -> dict[int, str]:
    return {value.number: value.name for value in kind.values}


def _same(value: Any) -> Any:
    return value


def _double(value: float) -> float | str:
    if math.isfinite(value):
        return value
    if math.isnan(value):
        return "NaN"
    return "Infinity" if value > 0 else "-Infinity"


def _bytes(value: bytes) -> str:
    return base64.b64encode(value).decode()


def _enum(value: int, names: dict[int, str]) -> int | str:
    return names.get(value, value)
