"""Requests of GET: a message's fields as query parameters."""

from typing import TypeVar

from google.protobuf.message import Message
from starlette.datastructures import QueryParams

from service.errors import BadField
from service.transports.rest.codec import from_document

_M = TypeVar("_M", bound=Message)


def read_parameters(message_type: type[_M], parameters: QueryParams) -> _M:
    """A message from the query of an address; its fields are scalars.

    Raises:
        BadField: a parameter that is none of the message's, is given twice, or cannot be read; names it.
    """
    document: dict[str, str] = {}
    for name, value in parameters.multi_items():
        if name in document:
            raise BadField(name, "is given more than once")
        document[name] = value
    return from_document(message_type, document)
