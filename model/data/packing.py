"""Packed rasters and map patches: one byte per pixel.

Rasters of many scenes lie in one flat array, row by row, with one bit per layer. Each has a border of one
empty pixel, so that a look-up clamped to one pixel outside finds zeros without testing for the raster's end.
"""

import numpy as np
import torch
from torch import Tensor

from model.arrays import Bytes, Float32s
from model.scenes.scene import Raster

LAYERS = 3
"""Bit 0 driveable area, bit 1 road dividers, bit 2 lane dividers."""


def pack(raster: Raster) -> Bytes:
    """Return a raster packed, flat, with its border: [(rows + 2) · (columns + 2)]."""
    bits = np.zeros(raster.layers.shape[1:], dtype=np.uint8)
    for layer in range(LAYERS):
        bits |= raster.layers[layer] << layer
    return np.pad(bits, 1).reshape(-1)


def unpack(packed: Bytes, rows: int, columns: int) -> Bytes:
    """Return the layers of a raster that ``pack`` packed: [3, rows, columns], 0 or 1."""
    bits = packed.reshape(rows + 2, columns + 2)[1:-1, 1:-1]
    return np.stack([bits >> layer & 1 for layer in range(LAYERS)])


_LEVELS = 4
"""Levels of a layer in a packed patch: 0, ⅓, ⅔, 1. Bilinear samples are between 0 and 1 at edges only."""
UNKNOWN = 1 << 6
"""Byte of an unknown pixel."""


def pack_patches(patches: Float32s) -> Bytes:
    """Return packed patches, with the layers of a pixel in one byte: [N, S, S].

    Args:
        patches: [N, 3, S, S] in [0, 1]; ½ in all layers where unknown.
    """
    level = np.round(patches * (_LEVELS - 1)).astype(np.uint8)
    packed: Bytes = level[:, 0] | np.left_shift(level[:, 1], 2) | np.left_shift(level[:, 2], 4)
    packed[(np.abs(patches - 0.5) < 1e-3).all(axis=1)] = UNKNOWN
    return packed


def without_layer(packed: Tensor, layer: int) -> Tensor:
    """Return packed patches in which a layer is absent; unknown pixels stay unknown."""
    return packed & ~(_LEVELS - 1 << 2 * layer)


def _table() -> Tensor:
    """Return the layers of each byte: [256, 3] in [-1, 1], 0 where unknown."""
    byte = torch.arange(256)
    layers = torch.stack([byte >> 2 * layer & 3 for layer in range(LAYERS)], dim=-1)
    table = 2 * layers.float() / (_LEVELS - 1) - 1
    table[byte >= UNKNOWN] = 0.0
    return table


_TABLE = _table()


def unpack_patches(packed: Tensor) -> Tensor:
    """Return patches that ``pack_patches`` packed: [N, 3, S, S] in [-1, 1], 0 unknown, rounded to its levels.

    Their memory layout is channels last, which is fastest for convolutions.

    Args:
        packed: [N, S, S] uint8.
    """
    layers = torch.nn.functional.embedding(packed.to(torch.int32), _TABLE.to(packed.device))
    return layers.permute(0, 3, 1, 2)
