"""Files of contract messages: protobuf JSON or binary protobuf."""

import sys
from pathlib import Path
from typing import TypeVar

from google.protobuf import json_format
from google.protobuf.message import DecodeError, Message

AnyMessage = TypeVar("AnyMessage", bound=Message)

STANDARD_INPUT = "-"
_BINARY, _JSON = ".binpb", ".json"


def read_message(source: str, message: AnyMessage) -> AnyMessage:
    """Read a message from a file.

    Args:
        source: path; ``*.binpb`` is binary and ``*.json`` JSON; the first character decides for other names
            and for ``-``, standard input.
        message: an empty message, which is filled and returned.

    Raises:
        OSError: the file cannot be read.
        ValueError: it holds no such message.
    """
    content = sys.stdin.buffer.read() if source == STANDARD_INPUT else Path(source).read_bytes()
    suffix = Path(source).suffix
    try:
        if suffix == _JSON or (suffix != _BINARY and content.lstrip().startswith(b"{")):
            return json_format.Parse(content, message)
        message.ParseFromString(content)
    except (json_format.ParseError, DecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{source} holds no {message.DESCRIPTOR.name}: {error}") from error
    return message


def write_message(path: Path, message: Message) -> None:
    """Write a message: binary protobuf where the name ends in ``.binpb``, JSON otherwise.

    Raises:
        OSError: the file cannot be written.
    """
    if path.suffix == _BINARY:
        path.write_bytes(message.SerializeToString())
    else:
        path.write_text(to_json(message) + "\n", encoding="utf-8")


def to_json(message: Message) -> str:
    """Return protobuf JSON on one line, with the contract's field names."""
    return json_format.MessageToJson(message, preserving_proto_field_name=True, indent=None)
