"""Messages of the contract in files: protobuf JSON or binary protobuf."""

import sys
from pathlib import Path
from typing import TypeVar

from google.protobuf import json_format
from google.protobuf.message import DecodeError, Message

AnyMessage = TypeVar("AnyMessage", bound=Message)

STANDARD_INPUT = "-"
_BINARY, _JSON = ".binpb", ".json"


def read_message(source: str, message: AnyMessage) -> AnyMessage:
    """Fills a message from a file.

    Args:
        source: ``*.binpb`` is binary, ``*.json`` JSON; of others, and of ``-`` for standard input, the first
            character tells.
        message: an empty one.

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
    """Writes a message, as binary protobuf where the name ends in ``.binpb``, else as JSON.

    Raises:
        OSError: the file cannot be written.
    """
    if path.suffix == _BINARY:
        path.write_bytes(message.SerializeToString())
    else:
        path.write_text(to_json(message) + "\n", encoding="utf-8")


def to_json(message: Message) -> str:
    """Protobuf JSON with the contract's own field names, on one line."""
    return json_format.MessageToJson(message, preserving_proto_field_name=True, indent=None)
