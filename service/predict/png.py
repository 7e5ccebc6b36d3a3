"""PNG files cut down to their pixels.

A PNG carries more than a picture: texts and profiles, some of them compressed, which a decoder unpacks
whoever asks for them. What a stranger sent goes to the decoder without all that.
"""

import struct
from dataclasses import dataclass

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_LENGTH_AND_NAME = struct.Struct(">I4s")
_HEADER = struct.Struct(">IIBB")
_CHECKSUM_BYTES = 4
_FEW_CHUNKS = 256
"""Chunks that any file may have; one a row, at the most, is what encoders write for a patch."""
_BYTES_PER_CHUNK = 1024
"""In a larger file: encoders fill chunks of 8 KiB and more."""


class PngError(Exception):
    """It is no PNG, or one that no encoder of pictures writes."""


@dataclass(frozen=True)
class Header:
    """What a PNG says of its pixels."""

    width: int
    height: int
    bit_depth: int
    color_type: int


def read_header(png: bytes) -> Header:
    """The header; nothing else is looked at.

    Raises:
        PngError: there is none.
    """
    start = len(_SIGNATURE)
    body = start + _LENGTH_AND_NAME.size
    if not png.startswith(_SIGNATURE) or len(png) < body + _HEADER.size or png[start + 4 : body] != b"IHDR":
        raise PngError("is not a PNG")
    return Header(*_HEADER.unpack_from(png, body))


def pixels_only(png: bytes) -> bytes:
    """The same picture of nothing but header, pixels and end.

    What else a picture cannot do without, such as a palette, true colour has no use for.

    Raises:
        PngError: a chunk reaches beyond the file, or there are too many.
    """
    most = _FEW_CHUNKS + len(png) // _BYTES_PER_CHUNK
    kept = [_SIGNATURE]
    position = len(_SIGNATURE)
    for _ in range(most):
        if position + _LENGTH_AND_NAME.size > len(png):
            raise PngError("is cut off")
        length, name = _LENGTH_AND_NAME.unpack_from(png, position)
        end = position + _LENGTH_AND_NAME.size + length + _CHECKSUM_BYTES
        if end > len(png):
            raise PngError("is cut off")
        if name in (b"IHDR", b"IDAT", b"IEND"):
            kept.append(png[position:end])
        if name == b"IEND":
            return b"".join(kept)
        position = end
    raise PngError(f"has more than {most} chunks")
