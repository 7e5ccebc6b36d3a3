"""Small requests in binary."""

from typing import TypeVar

from google.protobuf.message import DecodeError, Message

from service.errors import BadField

_M = TypeVar("_M", bound=Message)


def parse_message(message_type: type[_M], body: bytes) -> _M:
    """A message the fields of which are scalars.

    Raises:
        BadField: it is none.
    """
    try:
        return message_type.FromString(body)
    except DecodeError as error:
        raise BadField("body", f"is no {message_type.DESCRIPTOR.full_name}") from error
