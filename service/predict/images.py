"""Binary map layers out of bytes that a stranger sent."""

import io

import numpy as np
from PIL import Image

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Bytes
from service.errors import BadField
from service.predict.png import PngError, pixels_only, read_header

LAYERS = 3
_RGB_8 = (8, 2)  # bit depth, colour type


def decode_layers(
    image: pb.LayerImage, field: str, rows: int | None, columns: int | None, max_pixels: int
) -> Bytes:
    """Layers of an image as 0 and 1: uint8 [3, rows, columns].

    Args:
        image: packed bits or PNG.
        field: path of the image in the request, for faults.
        rows: how many it must have; None: whatever a PNG says.
        columns: likewise.
        max_pixels: rows × columns at most.

    Raises:
        BadField: the image is missing, of another size, or not what it claims to be.
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
    # The size is read from the header by hand and checked before Pillow sees a byte: a decompression
    # bomb is refused for what it says it is, and what says less than it holds is cut off there. Of the
    # rest Pillow gets the pixels alone: it would unpack every compressed text, too.
    try:
        header = read_header(png)
    except PngError as error:
        raise BadField(field, str(error)) from None
    width, height = header.width, header.height
    if (header.bit_depth, header.color_type) != _RGB_8:
        raise BadField(field, "must be 8-bit RGB without alpha")
    if (rows is not None and height != rows) or (columns is not None and width != columns):
        raise BadField(field, f"is {height} × {width} pixels, expected {rows or 'any'} × {columns or 'any'}")
    if not 0 < width * height <= max_pixels:
        raise BadField(field, f"is {height} × {width} pixels; 1 to {max_pixels} are accepted")
    try:
        with Image.open(io.BytesIO(pixels_only(png)), formats=["PNG"]) as picture:
            if picture.mode != "RGB" or picture.size != (width, height):
                raise BadField(field, "must be 8-bit RGB without alpha")
            pixels = np.asarray(picture)
    except BadField:
        raise
    except PngError as error:
        raise BadField(field, f"cannot be decoded: {error}") from None
    except Exception as error:  # Pillow raises a dozen kinds on broken data; each says the same here
        raise BadField(field, f"cannot be decoded: {type(error).__name__}") from error
    return np.ascontiguousarray((pixels >= 128).transpose(2, 0, 1)).view(np.uint8)
