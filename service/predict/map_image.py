"""Decoding of map images: binary layers from bytes that a stranger sent.

A PNG carries more than a picture: texts and profiles, some of them compressed, which a decoder unpacks even
if nobody reads them. Only header, pixels and end are passed to the decoder.
"""

import io
import struct

import numpy as np
from PIL import Image

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Bytes
from service.errors import BadField

LAYERS = 3

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_LENGTH_AND_NAME = struct.Struct(">I4s")
_HEADER = struct.Struct(">IIBB")
"""Width, height, bit depth, colour type."""
_CHECKSUM_BYTES = 4
_RGB_8 = (8, 2)  # bit depth, colour type
_FEW_CHUNKS = 256
"""Number of chunks that any file may have; encoders write at most one per row of a patch."""
_BYTES_PER_CHUNK = 1024
"""Min average size of further chunks; encoders fill chunks of 8 KiB and more."""


class PngError(Exception):
    """The bytes are no PNG, or one that no image encoder writes."""


def decode_layers(
    image: pb.LayerImage, field: str, rows: int | None, columns: int | None, max_pixels: int
) -> Bytes:
    """Return the layers of an image as 0 and 1: uint8 [3, rows, columns].

    Args:
        image: the image, as packed bits or PNG.
        field: the path of the image in the request, for faults.
        rows: the expected number of rows; None: as the PNG's header says.
        columns: the expected number of columns; None: as the PNG's header says.
        max_pixels: max rows × columns.

    Raises:
        BadField: the image is missing, of another size, or malformed.
    """
    encoding = image.WhichOneof("encoding")
    if encoding == "packed_bits":
        return _unpack(image.packed_bits, f"{field}.packed_bits", rows, columns)
    if encoding == "png":
        return _decode_png(image.png, f"{field}.png", rows, columns, max_pixels)
    raise BadField(field, "give packed_bits or png")


def _unpack(packed: bytes, field: str, rows: int | None, columns: int | None) -> Bytes:
    if rows is None or columns is None:
        raise BadField(field, "needs rows and columns")
    bits = LAYERS * rows * columns
    expected = (bits + 7) // 8
    if len(packed) != expected:
        raise BadField(field, f"{rows} × {columns} pixels need {expected} bytes, got {len(packed)}")
    flat = np.unpackbits(np.frombuffer(packed, dtype=np.uint8))
    if flat[bits:].any():
        raise BadField(field, "the last byte must be filled with zeros")
    return flat[:bits].reshape(LAYERS, rows, columns)


def _decode_png(png: bytes, field: str, rows: int | None, columns: int | None, max_pixels: int) -> Bytes:
    # The size in the header is checked before Pillow sees a byte: a decompression bomb is refused for the
    # size that it states, and pixels beyond the stated size are cut off.
    try:
        width, height, *pixel_format = _read_header(png)
    except PngError as error:
        raise BadField(field, str(error)) from None
    if tuple(pixel_format) != _RGB_8:
        raise BadField(field, "must be 8-bit RGB without alpha")
    if (rows is not None and height != rows) or (columns is not None and width != columns):
        raise BadField(field, f"is {height} × {width} pixels, expected {rows or 'any'} × {columns or 'any'}")
    if not 0 < width * height <= max_pixels:
        raise BadField(field, f"is {height} × {width} pixels; 1 to {max_pixels} are accepted")
    try:
        with Image.open(io.BytesIO(_pixels_only(png)), formats=["PNG"]) as picture:
            if picture.mode != "RGB" or picture.size != (width, height):
                raise BadField(field, "must be 8-bit RGB without alpha")
            pixels = np.asarray(picture)
    except BadField:
        raise
    except PngError as error:
        raise BadField(field, f"cannot be decoded: {error}") from None
    except Exception as error:  # Pillow raises a dozen types on broken data; all mean the same here
        raise BadField(field, f"cannot be decoded: {type(error).__name__}") from error
    return np.ascontiguousarray((pixels >= 128).transpose(2, 0, 1)).view(np.uint8)


def _read_header(png: bytes) -> tuple[int, int, int, int]:
    """Return width, height, bit depth and colour type of a PNG without reading beyond its header.

    Raises:
        PngError: there is no PNG header.
    """
    start = len(_SIGNATURE)
    body = start + _LENGTH_AND_NAME.size
    if not png.startswith(_SIGNATURE) or len(png) < body + _HEADER.size or png[start + 4 : body] != b"IHDR":
        raise PngError("is not a PNG")
    width, height, bit_depth, color_type = _HEADER.unpack_from(png, body)
    return width, height, bit_depth, color_type


def _pixels_only(png: bytes) -> bytes:
    """Return the PNG reduced to header, pixels and end; true colour needs no other chunk, such as a palette.

    Raises:
        PngError: a chunk reaches beyond the file, or there are too many chunks.
    """
    max_chunks = _FEW_CHUNKS + len(png) // _BYTES_PER_CHUNK
    kept = [_SIGNATURE]
    position = len(_SIGNATURE)
    for _ in range(max_chunks):
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
    raise PngError(f"has more than {max_chunks} chunks")
