"""Drawing of neighbours, as boxes, into a layer in the geometry of the map patch."""

import math

import torch
from torch import Tensor

from model.features.neighbor_boxes import BOX_REACH
from model.scenes.raster import COLUMNS_RIGHT, PATCH_PIXELS_PER_METER, PATCH_SIZE, ROWS_BEHIND

_RADIUS = math.floor(BOX_REACH * PATCH_PIXELS_PER_METER + math.sqrt(0.5))
"""Pixels; a box and its soft edge reach at most that far below the pixel of the box's middle, and one pixel
more above it."""


def rasterize_boxes(boxes: Tensor) -> Tensor:
    """Draw boxes into a layer in the geometry of the map patch (``model.scenes.raster``): rows ahead,
    columns left.

    The coverage of a pixel is the product of its coverages along and across the box. So edges are soft over
    one pixel, and a moving box changes the picture smoothly. Only pixels near a box are computed.

    Args:
        boxes: [N, S, 5], from ``model.features.neighbor_boxes``; boxes of length 0 are padding.

    Returns:
        [N, 100, 100] float32 from −1 (free) to 1 (covered).
    """
    agent, _ = drawn = (boxes[..., 3] > 0).nonzero(as_tuple=True)
    place, turn, size = boxes[drawn].split([2, 1, 2], dim=1)
    start = torch.tensor([ROWS_BEHIND, COLUMNS_RIGHT], dtype=place.dtype, device=place.device)
    middle = start + PATCH_PIXELS_PER_METER * place
    base = middle.floor()
    around = torch.arange(-_RADIUS, _RADIUS + 2, dtype=place.dtype, device=place.device)
    rows = around - (middle - base)[:, :1]  # [m, W], relative to the middle
    columns = around - (middle - base)[:, 1:]
    cos, sin = torch.cos(turn)[..., None], torch.sin(turn)[..., None]
    along = rows[:, :, None] * cos + columns[:, None, :] * sin  # [m, W, W]
    across = columns[:, None, :] * cos - rows[:, :, None] * sin
    half = 0.5 * PATCH_PIXELS_PER_METER * size[..., None, None]
    covered = _share(along, half[:, 0]) * _share(across, half[:, 1])

    # Pixels outside the patch fall on a border, which is cut off
    border = PATCH_SIZE + 2
    row, column = ((base[:, axis, None] + around + 1).clamp(0, border - 1).to(torch.int64) for axis in (0, 1))
    index = (agent[:, None] * border + row)[:, :, None] * border + column[:, None, :]
    picture = boxes.new_zeros(len(boxes) * border * border)
    picture.index_add_(0, index.flatten(), covered.flatten())
    inside = picture.view(len(boxes), border, border)[:, 1:-1, 1:-1]
    return inside.clamp(max=1.0) * 2 - 1


def _share(offset: Tensor, half: Tensor) -> Tensor:
    """Return the share of a pixel at an offset that an interval of ±half covers; all in pixels."""
    return torch.minimum((half + 0.5 - offset.abs()).clamp_min(0.0), (2 * half).clamp_max(1.0))
