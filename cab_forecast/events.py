"""Server-Sent Events to messages."""

import json
from collections.abc import Iterator
from typing import Generic, TypeVar

from google.protobuf import json_format
from google.protobuf.message import Message

from cab_forecast.errors import InternalError
from cab_forecast.rest_codec import error_from_problem

_Message = TypeVar("_Message", bound=Message)
_ERROR = "error"
"""Type of the event that says why there are no more."""


class EventReader(Generic[_Message]):
    """Takes a body as it comes, and gives the messages in it."""

    def __init__(self, message_type: type[_Message]) -> None:
        self._message_type = message_type
        self._rest = b""
        self._kind = ""
        self._data: list[str] = []

    def feed(self, chunk: bytes) -> Iterator[_Message]:
        """The messages that a piece of the body completes; an empty one tells nothing but that it has begun,
        which the headers told.

        Raises:
            ForecastError: the server says that it failed, or says what cannot be read.
        """
        # Lines end at "\n" alone: others that Python knows of may be inside an id
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        for line in lines:
            name, _, value = line.removesuffix(b"\r").decode(errors="replace").partition(":")
            if name == "data":
                self._data.append(value.removeprefix(" "))
            elif name == "event":
                self._kind = value.strip()
            elif not line.strip():
                message = self._message()
                if message.ByteSize():
                    yield message

    def _message(self) -> _Message:
        data, kind = "\n".join(self._data), self._kind
        self._data, self._kind = [], ""
        try:
            if not data:
                return self._message_type()
            if kind == _ERROR:
                problem = json.loads(data)
                raise error_from_problem(problem if isinstance(problem, dict) else {}, message="it failed")
            # A newer server may say more than this client knows of.
            return json_format.Parse(data, self._message_type(), ignore_unknown_fields=True)
        except (json_format.ParseError, ValueError) as error:
            raise InternalError(f"an event cannot be read: {error}") from error
