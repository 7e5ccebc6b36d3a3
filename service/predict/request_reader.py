"""Reading of encoded requests, off the event loop and within size limits.

A megabyte can encode half a million agents. Readers therefore count what a body holds before they build
messages from it. For protobuf, the walk below visits the tags of the request and of its agents, never deeper,
and stops at the first limit that is exceeded. It does not validate: malformed bodies are left to the parser.
But it must never count less than the parser would build.
"""

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Generic, TypeVar

from google.protobuf.message import DecodeError

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.explanation_service_pb2 import ExplainRequest
from service.errors import BadField, Overloaded, TooLarge
from service.settings import Settings

LARGE_BYTES = 256 * 2**10
"""Size above which bodies are read one at a time: some take a second, hold the interpreter lock meanwhile and
need many times their size in memory."""
MAX_WAITING = 8
"""Max number of large bodies that wait for their turn; each is kept in memory meanwhile."""
_RETRY_AFTER = 1.0
"""Seconds; about the time that the largest body takes."""
_MIN_STATES_LIMIT = 2**16
"""States that any request may hold, however low the limits are: one agent with too many states is then
reported as invalid, and the other agents get their forecasts."""

SceneRequest = TypeVar("SceneRequest", pb.PredictRequest, ExplainRequest)
"""Requests about a scene, whose agents have the same field number."""

_AGENTS = pb.PredictRequest.AGENTS_FIELD_NUMBER
if ExplainRequest.AGENTS_FIELD_NUMBER != _AGENTS:
    raise ImportError("requests number their agents differently: service.predict.request_reader counts them")
_STATES = pb.Agent.STATES_FIELD_NUMBER
_OTHER_FIELDS = 64
"""Max number of fields of a message besides agents or states; leaves room for fields of newer clients."""
_MIN_FIELD_BYTES = 2
"""Size of the smallest field: a tag and a length of zero."""

_VARINT, _FIXED64, _BYTES, _GROUP, _END_GROUP, _FIXED32 = range(6)
# The fields of a group are counted as its parent's.
_FIXED_SIZES = {_FIXED64: 8, _FIXED32: 4, _GROUP: 0, _END_GROUP: 0}
_MAX_VARINT_BYTES = 10
_MAX_TAG = 2**32 - 1


@dataclass(frozen=True)
class RequestLimits:
    """Limits of what one request may hold."""

    agents: int
    """Max number of agents."""
    states: int
    """Max number of states of all agents together."""

    @classmethod
    def from_settings(cls, settings: Settings) -> "RequestLimits":
        """Return the limits that follow from the settings."""
        return cls(settings.max_agents, max(settings.max_agents * settings.max_states, _MIN_STATES_LIMIT))

    def check_agents(self, agents: int) -> None:
        """Refuse a request with too many agents.

        Raises:
            TooLarge: there are more agents than the limit.
        """
        if agents > self.agents:
            raise TooLarge(f"more than {self.agents} agents")

    def check_states(self, states: int) -> None:
        """Refuse a request with too many states.

        Raises:
            TooLarge: there are more states than the limit.
        """
        if states > self.states:
            raise TooLarge(f"more than {self.states} states")


@dataclass(frozen=True)
class EncodedRequest(Generic[SceneRequest]):
    """A request body with its parser."""

    body: bytes
    parse: Callable[[bytes], SceneRequest]
    """Parser of the body; raises a ``ServiceError`` if the body is malformed or too large."""
    inline_bytes: int = 0
    """Size up to which parsing takes less time than the handover to a thread."""


class RequestReader:
    """Reader of encoded requests. Used on one event loop."""

    def __init__(self, threads: Executor) -> None:
        """
        Args:
            threads: the executor of the parsers.
        """
        self._threads = threads
        self._turn = asyncio.Lock()
        self._waiting = 0

    async def read(self, encoded: EncodedRequest[SceneRequest]) -> SceneRequest:
        """Return the parsed request.

        Raises:
            Overloaded: the body is large, and too many large ones are waiting already.
            ServiceError: the parser refused the body.
        """
        size = len(encoded.body)
        if size <= encoded.inline_bytes:
            return encoded.parse(encoded.body)
        if size <= LARGE_BYTES:
            return await self._parse_in_thread(encoded)
        if self._waiting >= MAX_WAITING:
            raise Overloaded(f"{self._waiting} large requests are waiting to be read", _RETRY_AFTER)
        self._waiting += 1
        try:
            await self._turn.acquire()
        finally:
            self._waiting -= 1
        parsing = self._parse_in_thread(encoded)
        parsing.add_done_callback(self._pass_turn)
        # A thread cannot be stopped: the turn lasts until it ends, even if the caller is cancelled
        return await asyncio.shield(parsing)

    def _parse_in_thread(self, encoded: EncodedRequest[SceneRequest]) -> "asyncio.Future[SceneRequest]":
        return asyncio.get_running_loop().run_in_executor(self._threads, encoded.parse, encoded.body)

    def _pass_turn(self, parsing: "asyncio.Future[SceneRequest]") -> None:
        self._turn.release()
        if not parsing.cancelled():
            parsing.exception()  # retrieved, or asyncio would log that it never was


def read_protobuf(kind: type[SceneRequest], body: bytes, limits: RequestLimits) -> SceneRequest:
    """Return the request that a protobuf body encodes.

    Args:
        kind: type of the request.
        body: the body.
        limits: the limits.

    Raises:
        TooLarge: the request holds more agents or states than the limits.
        BadField: the body is malformed.
    """
    _check_protobuf(body, limits)
    try:
        return kind.FromString(body)
    except DecodeError as error:
        raise BadField("body", f"is no {kind.DESCRIPTOR.full_name}") from error


def _check_protobuf(body: bytes, limits: RequestLimits) -> None:
    agents = []
    others = 0
    for number, start, end in _fields(body, 0, len(body)):
        if number == _AGENTS and end is not None:
            agents.append((start, end))
            limits.check_agents(len(agents))
        else:
            others += 1
            _check_others(others, _OTHER_FIELDS)
    if len(body) // _MIN_FIELD_BYTES <= limits.states:
        return  # too short to hold too many states
    states = 0
    others = 0
    for agent_start, agent_end in agents:
        for number, _, end in _fields(body, agent_start, agent_end):
            if number == _STATES and end is not None:
                states += 1
                limits.check_states(states)
            else:
                others += 1
                _check_others(others, _OTHER_FIELDS * len(agents))


def _check_others(fields: int, limit: int) -> None:
    if fields > limit:
        raise TooLarge(f"more than {limit} fields that are neither agents nor states")


def _fields(body: bytes, position: int, stop: int) -> Iterator[tuple[int, int, int | None]]:
    """Yield the fields of the message in ``body[position:stop]``: number, start and end of the contents.

    The end is None unless the contents are bytes. The iterator ends early where the message is malformed.
    """
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
    return (tag & _MAX_TAG) >> 3  # some parsers drop the bits above


def _varint(body: bytes, position: int, stop: int) -> tuple[int, int]:
    """Return a varint and the position after it; a position beyond ``stop`` if it is malformed."""
    value = 0
    for index in range(_MAX_VARINT_BYTES):
        if position + index >= stop:
            break
        byte = body[position + index]
        value |= (byte & 0x7F) << 7 * index
        if byte <= 0x7F:
            return value, position + index + 1
    return 0, stop + 1
