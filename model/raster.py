"""Map patches of agents, cut from the raster of a scene.

Geometry as in Trajectron++ (Salzmann et al. 2020) on nuScenes: a patch is 100 × 100 pixels at 3 pixels a
metre in the agent's frame; it begins 10 pixels behind the agent and 50 pixels to its right. Element (row i,
column j) shows the ground point ``position + R(heading) · ((i − 10) / 3, (j − 50) / 3)`` m: rows go ahead,
columns to the left.
"""

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from model.arrays import Bytes, Float32s, Floats
from model.scene import Raster

PATCH_SIZE = 100
"""Rows and columns of a patch."""
PATCH_PIXELS_PER_METER = 3.0
"""Resolution of a patch, whatever the raster's."""
ROWS_BEHIND = 10
"""The agent's row: 10 rows (3.3 m) lie behind it, 90 (30 m) ahead."""
COLUMNS_RIGHT = 50
"""The agent's column: 50 columns (16.7 m) lie to its right, 50 to its left."""

_REACH = math.hypot(PATCH_SIZE - ROWS_BEHIND, PATCH_SIZE - COLUMNS_RIGHT)
"""No pixel of a patch is farther from its agent, patch pixels."""


def cut_patches(raster: Raster, position: Floats, heading: Floats) -> Float32s:
    """Map patches of N agents, bilinear between raster pixels, zero outside the raster.

    A raster of twice the patch's resolution or more is first brought near it, so that thin lines stay.

    Positions are taken relative to the raster's origin in float64 and used to the fraction of a pixel.

    Args:
        raster: the scene's map, any resolution.
        position: [N, 2], m, ground frame.
        heading: [N], rad.

    Returns:
        [N, 3, 100, 100] in [0, 1].

    Raises:
        ValueError: a position or heading is not finite.
    """
    count = len(position)
    if not (np.isfinite(position).all() and np.isfinite(heading).all()):
        raise ValueError("a map patch needs a finite position and heading")
    layers, rows, columns = raster.layers.shape
    patches = np.zeros((count, layers, PATCH_SIZE, PATCH_SIZE), dtype=np.float32)
    # Raster pixels, from here on; (row, column) go with ground (x, y).
    center = (position - raster.origin) * raster.pixels_per_meter
    reach = _REACH * raster.pixels_per_meter / PATCH_PIXELS_PER_METER + 1
    on_map = ((center > -reach) & (center < np.array([rows, columns]) - 1 + reach)).all(axis=1)
    if not (on_map.any() and raster.layers.size):
        return patches
    # Only the part that the agents can see is turned into floats.
    low = np.maximum(np.floor(center[on_map].min(axis=0) - reach), 0).astype(np.int64)
    high = np.minimum(np.ceil(center[on_map].max(axis=0) + reach) + 1, [rows, columns]).astype(np.int64)
    factor = max(int(raster.pixels_per_meter / PATCH_PIXELS_PER_METER), 1)
    pixels = _coarsened(raster.layers[:, low[0] : high[0], low[1] : high[1]], factor)
    crop = torch.from_numpy(pixels.astype(np.float32))
    # Of coarser pixels, whose middle is that of those that they are made of
    coarse = (center[on_map] - low - (factor - 1) / 2) / factor
    scale = raster.pixels_per_meter / PATCH_PIXELS_PER_METER / factor
    seen = functional.grid_sample(
        crop.expand(int(on_map.sum()), -1, -1, -1),  # no copy: all agents read the same pixels
        _grid(scale, coarse, heading[on_map], (crop.shape[1], crop.shape[2])),
        mode="bilinear",
        padding_mode="zeros",
        align_corners=False,
    )
    if on_map.all():
        return seen.numpy()
    patches[on_map] = seen.numpy()
    return patches


def _coarsened(layers: Bytes, factor: int) -> Bytes:
    """The layers in pixels of ``factor`` × ``factor``, set where any of theirs is.

    Sampled as it is, a raster finer than the patch would lose lines that fall between the samples.
    """
    if factor == 1:
        return layers
    count, rows, columns = layers.shape
    padded = np.zeros((count, -(-rows // factor) * factor, -(-columns // factor) * factor), dtype=np.uint8)
    padded[:, :rows, :columns] = layers
    split = padded.reshape(count, padded.shape[1] // factor, factor, padded.shape[2] // factor, factor)
    coarse: Bytes = split.max(axis=(2, 4))
    return coarse


def _grid(scale: float, center: Floats, heading: Floats, shape: tuple[int, int]) -> Tensor:
    """Where each patch pixel lies, in the coordinates of ``grid_sample`` (column first, ∓1 half a pixel
    outside the outermost pixels): [N, 100, 100, 2].

    Args:
        scale: pixels of what is sampled to a pixel of the patch.
        center: [N, 2], the agents, pixels.
        heading: [N], rad.
        shape: rows and columns of what is sampled.
    """
    cos, sin = scale * np.cos(heading), scale * np.sin(heading)
    # pixel = center + i' (cos, sin) + j' (−sin, cos), with i' and j' counted from the agent's row, column.
    ahead, left = np.stack([sin, cos], axis=-1), np.stack([cos, -sin], axis=-1)  # [N, (column, row)]
    half = np.array([shape[1], shape[0]]) / 2
    start = _float32((center[:, ::-1] + 0.5) / half - 1)[:, None]
    index = torch.arange(PATCH_SIZE, dtype=torch.float32)[:, None]
    along = start + (index - ROWS_BEHIND) * _float32(ahead / half)[:, None]  # [N, 100, 2]
    across = (index - COLUMNS_RIGHT) * _float32(left / half)[:, None]
    return along[:, :, None] + across[:, None]


def _float32(values: Floats) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))
