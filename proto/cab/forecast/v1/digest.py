"""Digest of a scene raster, by which calls name it.

The comment of ``SceneRaster.digest`` defines it. Server and client share this definition.
"""

import hashlib
import struct

from cab.forecast.v1.prediction_service_pb2 import LayerImage, SceneRaster

DIGEST_BYTES = 32
"""Size of a SHA-256 digest."""
_HEADER = struct.Struct("<BIIddd")
"""Number of the encoding, rows, columns, origin and pixels per metre."""


def raster_digest(raster: SceneRaster) -> bytes:
    """Return the digest of a raster with an image: SHA-256 of its encoding, geometry and encoded image.

    Args:
        raster: the raster; a digest that it already has does not count.

    Raises:
        ValueError: the raster has no image.
    """
    encoding = raster.image.WhichOneof("encoding")
    if encoding == "packed_bits":
        number, image = LayerImage.PACKED_BITS_FIELD_NUMBER, raster.image.packed_bits
    elif encoding == "png":
        number, image = LayerImage.PNG_FIELD_NUMBER, raster.image.png
    else:
        raise ValueError("a raster without an image has no digest")
    header = _HEADER.pack(
        number, raster.rows, raster.columns, raster.origin_x, raster.origin_y, raster.pixels_per_meter
    )
    digest = hashlib.sha256(header)
    digest.update(image)
    return digest.digest()
