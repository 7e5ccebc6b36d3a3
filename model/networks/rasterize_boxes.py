"""Draws the agents around into the picture that the map patch is."""

import math

import torch
from torch import Tensor

from model.features.neighbor_boxes import BOX_REACH
from model.scenes.raster import COLUMNS_RIGHT, PATCH_PIXELS_PER_METER, PATCH_SIZE, ROWS_BEHIND

_RADIUS = math.floor(BOX_REACH * PATCH_PIXELS_PER_METER + math.sqrt(0.5))
"""Pixels from the one that a box's middle lies in: none farther away than that, or one more upwards, is
touched by the box and its soft edge."""


def rasterize_boxes(boxes: Tensor) -> Tensor:
    """A picture of boxes in the geometry of the map patch (``model.scenes.raster``): rows ahead, columns
    left.

    A pixel is as much covered as each side of the box, had it no other, would cover of it: edges are soft
    over one pixel, so that a box moves smoothly. Only the pixels around each box are looked at.

    Args:
        boxes: [N, S, 5], as ``model.features.neighbor_boxes`` makes them; what has no length is not drawn.

    Returns:
        [N, 100, 100] float32 from −1 (free) to 1 (covered).
    """
    agent, _ = drawn = (boxes[..., 3] > 0).nonzero(as_tuple=True)
    place, turn, size = boxes[drawn].split([2, 1, 2], dim=1)
    start = torch.tensor([ROWS_BEHIND, COLUMNS_RIGHT], dtype=place.dtype, device=place.device)
    middle = start + PATCH_PIXELS_PER_METER * place
    base = middle.floor()
    around = torch.arange(-_RADIUS, _RADIUS + 2, dtype=place.dtype, device=place.device)
    rows = around - (middle - base)[:, :1]  # [m, W], from the middle
    columns = around - (middle - base)[:, 1:]
    cos, sin = torch.cos(turn)[..., None], torch.sin(turn)[..., None]
    along = rows[:, :, None] * cos + columns[:, None, :] * sin  # [m, W, W]
    across = columns[:, None, :] * cos - rows[:, :, None] * sin
    half = 0.5 * PATCH_PIXELS_PER_METER * size[..., None, None]
    covered = _share(along, half[:, 0]) * _share(across, half[:, 1])

    # A border takes what lies outside
    border = PATCH_SIZE + 2
    row, column = ((base[:, axis, None] + around + 1).clamp(0, border - 1).to(torch.int64) for axis in (0, 1))
    index = (agent[:, None] * border + row)[:, :, None] * border + column[:, None, :]
    picture = boxes.new_zeros(len(boxes) * border * border)
    picture.index_add_(0, index.flatten(), covered.flatten())
    inside = picture.view(len(boxes), border, border)[:, 1:-1, 1:-1]
    return inside.clamp(max=1.0) * 2 - 1


def _share(offset: Tensor, half: Tensor) -> Tensor:
    """How much of a pixel at that offset an interval of ±half covers, pixels."""
    return torch.minimum((half + 0.5 - offset.abs()).clamp_min(0.0), (2 * half).clamp_max(1.0))
