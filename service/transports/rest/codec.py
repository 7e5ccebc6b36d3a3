"""The contract's messages as JSON, by protobuf's JSON mapping.

Reading is protobuf's own ``ParseDict``: camelCase and snake_case names, numbers as strings, base64 bytes.
Writing is our own: a forecast is tens of thousands of numbers, over which ``MessageToDict`` takes one at
a time. Names are written in snake_case, and every field that has a default is written, so that a reader
finds each key.
"""

import base64
import functools
import math
import re
from collections.abc import Callable
from typing import Any, TypeVar

import orjson
from google.protobuf import json_format
from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.message import Message

from service.errors import BadField

_M = TypeVar("_M", bound=Message)
_Encoder = Callable[[Any], Any]

_FIELD_IN_ERROR = re.compile(r"Failed to parse (\w+) field")
_PATH_IN_ERROR = re.compile(r' at "?\w+((?:\.\w+(?:\[\d+\])?)*)"?\.*$')
_MAX_REASON = 200
_MAX_TEXT = 4000
_UNKNOWN_IN_ERROR = re.compile(r'has no field named "(.{0,64}?)" at "\w+((?:\.\w+(?:\[\d+\])?)*)"', re.DOTALL)


def parse_json(message_type: type[_M], body: bytes) -> _M:
    """A message from JSON.

    Raises:
        BadField: it is no JSON, or not of that message; names the field as far as it can be told.
    """
    return from_document(message_type, load_document(body))


def load_document(body: bytes) -> dict[str, Any]:
    """A JSON object.

    Raises:
        BadField: it is none.
    """
    try:
        document = orjson.loads(body)
    except orjson.JSONDecodeError as error:
        raise BadField("body", f"is no JSON: {error}") from error
    if not isinstance(document, dict):
        raise BadField("body", "must be a JSON object")
    return document


def from_document(message_type: type[_M], document: dict[str, Any]) -> _M:
    """A message from a JSON object.

    Raises:
        BadField: it is not of that message; names the field as far as it can be told.
    """
    message = message_type()
    try:
        json_format.ParseDict(document, message)
    except json_format.ParseError as error:
        raise _fault(str(error)) from error
    except (ValueError, TypeError, AttributeError, KeyError, ArithmeticError, RecursionError) as error:
        # What ParseDict lets through where a value is of a kind it did not think of
        raise BadField(
            "body", f"is no {message_type.DESCRIPTOR.name}: a value is of the wrong kind"
        ) from error
    return message


def to_json(message: Message) -> bytes:
    """A message as JSON."""
    return orjson.dumps(to_dict(message), option=orjson.OPT_NON_STR_KEYS)


def to_dict(message: Message) -> dict[str, Any]:
    """A message as JSON's types: what ``MessageToDict`` gives with proto field names and with fields
    without presence always printed."""
    encoded: dict[str, Any] = {}
    for name, has_presence, encode in _fields(message.DESCRIPTOR):
        if not has_presence or message.HasField(name):
            encoded[name] = encode(getattr(message, name))
    return encoded


def _fault(text: str) -> BadField:
    """The field that a ParseError is about, and why, from its text."""
    if len(text) > _MAX_TEXT:  # the value that is wrong may be megabytes
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
    # Without a path the text is of a Python exception inside ParseDict, which says nothing to a client
    if path is None and not reason.startswith("Value out of range"):
        reason = "is of the wrong kind"
    return BadField(field, reason[:_MAX_REASON])


def _snake(path: str) -> str:
    return re.sub(r"(?<=[a-z0-9])([A-Z])", lambda match: f"_{match[1].lower()}", path)


@functools.cache
def _fields(descriptor: Descriptor) -> tuple[tuple[str, bool, _Encoder], ...]:
    """For each field of a message: name, whether it knows if it was set, and how a value is written."""
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
    # One addition each tells whether all are finite (or huge: then they are looked at one by one)
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
