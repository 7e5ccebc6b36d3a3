"""Encoding and decoding of a map's three binary layers."""

import io
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from PIL import Image

from cab.forecast.v1.prediction_service_pb2 import LayerImage

Layers = npt.NDArray[np.bool_]
ImageEncoding = Literal["packed_bits", "png"]

LAYER_NAMES = ("driveable area", "road dividers", "lane dividers")
_COUNT = len(LAYER_NAMES)
_PNG_ONE = 255
_PNG_THRESHOLD = 128


def as_layers(layers: npt.ArrayLike) -> Layers:
    """Check map layers and convert them to booleans.

    Args:
        layers: [3, rows, columns], booleans, or numbers that are 0 or 1.

    Raises:
        ValueError: the shape or a value is not valid.
    """
    array: npt.NDArray[Any] = np.asarray(layers)
    if array.ndim != _COUNT or array.shape[0] != _COUNT or 0 in array.shape:
        raise ValueError(f"layers must be [{_COUNT}, rows, columns], but are {list(array.shape)}")
    if array.dtype != np.bool_ and not np.isin(array, (0, 1)).all():
        raise ValueError("layers must be binary: booleans, or zeros and ones")
    return array.astype(np.bool_)


def encode_layers(layers: npt.ArrayLike, encoding: ImageEncoding = "packed_bits") -> LayerImage:
    """Encode map layers.

    Args:
        layers: [3, rows, columns], binary.
        encoding: ``packed_bits`` is faster to read; ``png`` is many times smaller.

    Raises:
        ValueError: the layers are not binary or have another shape, or the encoding is unknown.
    """
    array = as_layers(layers)
    if encoding == "packed_bits":
        return LayerImage(packed_bits=np.packbits(array).tobytes())
    if encoding == "png":
        pixels = np.moveaxis(array, 0, -1).astype(np.uint8) * _PNG_ONE
        file = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(pixels)).save(file, format="PNG", optimize=True)
        return LayerImage(png=file.getvalue())
    raise ValueError(f"encoding must be 'packed_bits' or 'png', not {encoding!r}")


def decode_layers(image: LayerImage, rows: int, columns: int) -> Layers:
    """Decode map layers: [3, rows, columns].

    Args:
        image: packed bits, or a PNG.
        rows: number of rows; 0, for a PNG only: the image's own.
        columns: number of columns; 0, for a PNG only: the image's own.

    Raises:
        ValueError: there is no image, or its size differs.
    """
    if image.WhichOneof("encoding") == "png":
        pixels = np.asarray(Image.open(io.BytesIO(image.png)).convert("RGB"))
        if (rows or pixels.shape[0], columns or pixels.shape[1]) != pixels.shape[:2]:
            raise ValueError(
                f"the PNG has {pixels.shape[0]} × {pixels.shape[1]} pixels, not {rows} × {columns}"
            )
        return np.moveaxis(pixels, -1, 0) >= _PNG_THRESHOLD
    bits = _COUNT * rows * columns
    if not bits or len(image.packed_bits) != -(-bits // 8):
        raise ValueError(f"{len(image.packed_bits)} bytes cannot be {_COUNT} × {rows} × {columns} bits")
    packed = np.frombuffer(image.packed_bits, dtype=np.uint8)
    return np.unpackbits(packed, count=bits).reshape(_COUNT, rows, columns).astype(np.bool_)
