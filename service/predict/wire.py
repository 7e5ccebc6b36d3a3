"""Packed fields of protobuf's wire format, from arrays.

A response has tens of thousands of numbers, and protobuf takes lists of them number by number. In wire
format, a packed field of doubles is a tag, a length and the doubles' bytes, which an array holds already; a
message merges them as one copy.
"""

import functools

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from model.arrays import Floats

_LENGTH_DELIMITED = 2  # wire type


def packed_doubles(tag: bytes, values: Floats) -> bytes:
    """Return a packed field of doubles; nothing for no values, as protobuf writes it.

    Args:
        tag: the field's tag, from ``packed_tag``.
        values: any shape, in the order of its elements.
    """
    if not values.size:
        return b""
    return _header(tag, 8 * values.size) + values.astype("<f8", copy=False).tobytes()


@functools.lru_cache(maxsize=1024)
def _header(tag: bytes, size: int) -> bytes:
    return tag + varint(size)


def packed_tag(message: Descriptor, name: str) -> bytes:
    """Return the tag of a packed field of doubles.

    Raises:
        ValueError: the field is not one.
    """
    field: FieldDescriptor = message.fields_by_name[name]
    if not (field.is_packed and field.type == FieldDescriptor.TYPE_DOUBLE):
        raise ValueError(f"{message.name}.{name} is no packed field of doubles")
    return varint(field.number << 3 | _LENGTH_DELIMITED)


def varint(value: int) -> bytes:
    """Return a number that is not negative in seven bits a byte, the lowest first."""
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)
