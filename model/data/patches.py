"""Map patches of agents in many scenes, cut from the rasters of a cache.

The patches equal those of ``model.scenes.raster.cut_patches``, by which serving cuts them.
"""

from collections.abc import Collection

import numpy as np
import torch
from torch import Tensor

from model.arrays import Floats, Ints
from model.data.cache import Cache
from model.data.packing import LAYERS
from model.features.agent_features import OUTSIDE, PATCHES
from model.scenes.raster import (
    COLUMNS_RIGHT,
    PATCH_PIXELS_PER_METER,
    PATCH_SIZE,
    ROWS_BEHIND,
    raster_view,
)

_CHUNK = {"cpu": 8}
"""Agents at once, by type of device; so few fit into a CPU's cache."""
_OTHER_CHUNK = 512
_FAR = 1e4
"""Pixels; agents farther outside their raster are treated as this far outside, as they see nothing of it."""


def agent_frame_patches(cache: Cache, rows: Ints, names: Collection[str]) -> dict[str, Tensor]:
    """Return the map patches that a network of the agent's frame is shown in serving.

    The cache's own ``near_patch`` and ``far_patch`` are these, rounded.

    Args:
        cache: cache with rasters and poses.
        rows: [n], rows of the cache; it is fastest if they are of few scenes.
        names: names of their features, of ``PATCHES``.

    Returns:
        [n, 3, S, S] float32 in [-1, 1] by name: absent −1, present 1, bilinear between, 0 unknown. They are
        on the CPU, channels last, which is fastest for convolutions.
    """
    form = (len(rows), LAYERS, PATCH_SIZE, PATCH_SIZE)
    made = {name: torch.empty(form, memory_format=torch.channels_last) for name in names}
    scenes = cache.scene[rows]
    for scene in np.unique(scenes).tolist():
        here = np.flatnonzero(scenes == scene)
        raster = cache.raster(scene)
        position, heading = cache.position[rows[here]], cache.heading[rows[here]]
        for name in names:
            view = raster_view(raster, position, heading, PATCHES[name], OUTSIDE)
            made[name][here] = torch.from_numpy(view.cut())
    return made


class PatchCutter:
    """Cutter of the map patches of a cache's pairs in the ground frame, on any device; all agents of a batch
    share one look-up."""

    def __init__(self, cache: Cache, device: torch.device) -> None:
        """
        Args:
            cache: cache with rasters and poses.
            device: device on which patches are cut; a GPU gets a copy of the rasters.
        """
        self._rasters = torch.from_numpy(cache.rasters).to(device)
        rows_columns = cache.raster_shape[cache.scene]
        scale = cache.raster_pixels_per_meter[cache.scene]
        center = (cache.position - cache.raster_origin[cache.scene]) * scale[:, None]
        center = np.clip(center, -_FAR, rows_columns + _FAR)
        # Pixels are relative to the agent's: small numbers, which float32 represents to 1e-5
        base = np.floor(center).astype(np.int64)
        stride = rows_columns[:, 1] + 2
        start = cache.raster_start[cache.scene] + (base[:, 0] + 1) * stride + base[:, 1] + 1

        def tensor(values: Floats | Ints, dtype: torch.dtype) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(device, dtype)

        self._start = tensor(start, torch.int64)
        self._stride = tensor(stride, torch.int64)
        self._fraction = tensor(center - base, torch.float32)
        self._low = tensor(-1 - base, torch.float32)
        self._high = tensor(rows_columns - base, torch.float32)
        zoom = scale / PATCH_PIXELS_PER_METER
        directions = np.stack([zoom * np.cos(cache.heading), zoom * np.sin(cache.heading)], axis=-1)
        self._ahead = tensor(directions, torch.float32)
        index = torch.arange(PATCH_SIZE, dtype=torch.float32, device=device)
        self._rows, self._columns = index - ROWS_BEHIND, index - COLUMNS_RIGHT

    def __call__(self, indices: Tensor) -> Tensor:
        """Return the patches of pairs.

        Args:
            indices: [n] int64, on the device.

        Returns:
            [n, 3, 100, 100] float32 in [-1, 1]: absent −1, present 1, bilinear between; −1 outside.
        """
        patches = torch.empty((len(indices), LAYERS, PATCH_SIZE, PATCH_SIZE), device=indices.device)
        chunk = _CHUNK.get(indices.device.type, _OTHER_CHUNK)
        for some, out in zip(indices.split(chunk), patches.split(chunk), strict=True):
            self._cut(some, out)
        return patches

    def _cut(self, indices: Tensor, out: Tensor) -> None:
        ahead = self._ahead[indices]
        cos, sin = ahead[:, :1], ahead[:, 1:]
        fraction, low, high = self._fraction[indices], self._low[indices], self._high[indices]

        def axis(k: int, along: Tensor, across: Tensor) -> tuple[Tensor, Tensor]:
            """Return each patch pixel's place in the raster, relative to the agent: whole and fraction."""
            a = fraction[:, k, None] + self._rows * along
            place = a[:, :, None] + (self._columns * across)[:, None]
            # Outside there is only the border of zeros
            place = torch.minimum(torch.maximum(place, low[:, k, None, None]), high[:, k, None, None])
            whole = torch.minimum(place.floor(), high[:, k, None, None] - 1)
            return whole, place.sub_(whole)

        row, row_rest = axis(0, cos, -sin)
        column, column_rest = axis(1, sin, cos)
        stride = self._stride[indices][:, None, None]
        index = row.to(torch.int64).mul_(stride).add_(column.to(torch.int64))
        index += self._start[indices][:, None, None]
        corners = [
            self._rasters.index_select(0, corner.flatten()).view(index.shape)
            for corner in (index, index + 1, index + stride, index + (stride + 1))
        ]
        for layer in range(LAYERS):
            # A layer's bit, as a number
            near, near_right, far, far_right = (
                (corner & (1 << layer)).to(torch.float32) for corner in corners
            )
            first = torch.lerp(near, near_right, column_rest)
            second = torch.lerp(far, far_right, column_rest)
            scale = 2 / (1 << layer)
            torch.lerp(first, second, row_rest, out=first)
            torch.sub(first.mul_(scale), 1, out=out[:, layer])
