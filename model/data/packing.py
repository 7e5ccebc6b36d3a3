"""Rasters of many scenes in one flat array: a byte a pixel, a layer a bit.

Each raster has a border of one empty pixel all around, row by row. So a look-up that is clamped to one
pixel outside finds zeros there without being told where the raster ends.
"""

import numpy as np

from model.arrays import Bytes
from model.scene import Raster

LAYERS = 3
"""Bit 0 driveable area, bit 1 road dividers, bit 2 lane dividers."""


def pack(raster: Raster) -> Bytes:
    """[(rows + 2) · (columns + 2)], flat, with the border."""
    bits = np.zeros(raster.layers.shape[1:], dtype=np.uint8)
    for layer in range(LAYERS):
        bits |= raster.layers[layer] << layer
    return np.pad(bits, 1).reshape(-1)


def unpack(packed: Bytes, rows: int, columns: int) -> Bytes:
    """[3, rows, columns], 0 or 1, of what ``pack`` made of a raster of that size."""
    bits = packed.reshape(rows + 2, columns + 2)[1:-1, 1:-1]
    return np.stack([bits >> layer & 1 for layer in range(LAYERS)])
