"""Requests in protobuf's wire form: counted first, then read.

The walk below goes over the tags of the request and of its agents, never deeper, and gives up as soon as a
bound is passed. It need not tell what is well-formed: the parser does, and where the walk loses its way the
parser does, too. But it must not count less than the parser makes.
"""

from collections.abc import Iterator

from google.protobuf.message import DecodeError

from cab.forecast.v1 import prediction_service_pb2 as pb
from service.errors import BadField, TooLarge
from service.predict.request_limits import Sizes

_AGENTS = pb.PredictRequest.AGENTS_FIELD_NUMBER
_STATES = pb.Agent.STATES_FIELD_NUMBER
_OTHER_FIELDS = 64
"""Fields besides agents or states that a message may have: the few there are, those of a newer client."""
_SMALLEST_FIELD = 2
"""Bytes: a tag, and a length of nothing."""

_VARINT, _FIXED64, _BYTES, _GROUP, _END_GROUP, _FIXED32 = range(6)
_FIXED_SIZES = {_FIXED64: 8, _FIXED32: 4, _GROUP: 0, _END_GROUP: 0}  # a group's fields count as its parent's
_MAX_VARINT_BYTES = 10
_MAX_TAG = 2**32 - 1


def read_request(body: bytes, sizes: Sizes) -> pb.PredictRequest:
    """A request from its wire form.

    Raises:
        TooLarge: it holds more agents or states than it may.
        BadField: it is no request.
    """
    _check(body, sizes)
    try:
        return pb.PredictRequest.FromString(body)
    except DecodeError as error:
        raise BadField("body", f"is no {pb.PredictRequest.DESCRIPTOR.full_name}") from error


def _check(body: bytes, sizes: Sizes) -> None:
    agents = []
    others = 0
    for number, start, end in _fields(body, 0, len(body)):
        if number == _AGENTS and end is not None:
            agents.append((start, end))
            sizes.check_agents(len(agents))
        else:
            others += 1
            _check_others(others, _OTHER_FIELDS)
    if len(body) // _SMALLEST_FIELD <= sizes.states:
        return  # there is no room for too many
    states = 0
    others = 0
    for agent_start, agent_end in agents:
        for number, _, end in _fields(body, agent_start, agent_end):
            if number == _STATES and end is not None:
                states += 1
                sizes.check_states(states)
            else:
                others += 1
                _check_others(others, _OTHER_FIELDS * len(agents))


def _check_others(fields: int, most: int) -> None:
    if fields > most:
        raise TooLarge(f"more than {most} fields that are neither agents nor states")


def _fields(body: bytes, position: int, stop: int) -> Iterator[tuple[int, int, int | None]]:
    """The fields of the message that a part of the body is: number, start and end of the contents; no end
    where they are no bytes. Ends early where that part is no message."""
    while position < stop:
        tag = body[position]
        position += 1
        if tag > 0x7F:
            tag, position = _varint(body, position - 1, stop)
        wire_type = tag & 7
        if wire_type == _BYTES:
            if position >= stop:
                return
            length = body[position]
            position += 1
            if length > 0x7F:
                length, position = _varint(body, position - 1, stop)
            end = position + length
            if end > stop:
                return
            yield _number(tag), position, end
            position = end
        elif wire_type == _VARINT:
            _, position = _varint(body, position, stop)
            yield _number(tag), position, None
        elif wire_type in _FIXED_SIZES:
            position += _FIXED_SIZES[wire_type]
            yield _number(tag), position, None
        else:
            return


def _number(tag: int) -> int:
    return (tag & _MAX_TAG) >> 3  # a parser that drops the bits above sees that field


def _varint(body: bytes, position: int, stop: int) -> tuple[int, int]:
    """A number, and where it ends; beyond the end of everything where it does not."""
    value = 0
    for index in range(_MAX_VARINT_BYTES):
        if position + index >= stop:
            break
        byte = body[position + index]
        value |= (byte & 0x7F) << 7 * index
        if byte <= 0x7F:
            return value, position + index + 1
    return 0, stop + 1
