"""Map patches of agents, cut from the raster of a scene.

Geometry as in Trajectron++ (Salzmann et al. 2020) on nuScenes: a patch is 100 × 100 pixels at 3 pixels a
metre in the agent's frame; it begins 10 pixels behind the agent and 50 pixels to its right. Element (row i,
column j) shows the ground point ``position + R(heading) · ((i − 10) / 3, (j − 50) / 3)`` m: rows go ahead,
columns to the left.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from model.arrays import Bytes, Float32s, Floats, Ints
from model.scenes.scene import Raster, Scene

PATCH_SIZE = 100
"""Rows and columns of a patch."""
PATCH_PIXELS_PER_METER = 3.0
"""Resolution of a patch, independent of the raster's."""
ROWS_BEHIND = 10
"""The agent's row: 10 rows (3.3 m) lie behind it, 90 (30 m) ahead."""
COLUMNS_RIGHT = 50
"""The agent's column: 50 columns (16.7 m) lie to its right, 50 to its left."""


@dataclass(frozen=True)
class PatchGeometry:
    """The geometry of a square patch in its agent's frame: element (i, j) shows the point
    (i − rows_behind, j − columns_right) / pixels_per_meter ahead and to the left of the agent."""

    size: int
    """Rows and columns."""
    pixels_per_meter: float
    rows_behind: int
    columns_right: int

    @property
    def reach(self) -> float:
        """Pixels from the agent to the farthest corner."""
        return math.hypot(self.size - self.rows_behind, self.size - self.columns_right)


NEAR = PatchGeometry(PATCH_SIZE, PATCH_PIXELS_PER_METER, ROWS_BEHIND, COLUMNS_RIGHT)
"""30 m ahead, 3.3 m behind, 16.7 m to each side."""
FAR = PatchGeometry(PATCH_SIZE, 1.4, 14, 50)
"""61 m ahead, 10 m behind, 36 m to each side: no corner is farther than 74 m, where recorded rasters end
(a patch that reached beyond that would reveal where no recorded agent goes)."""


def map_patches(
    scene: Scene,
    targets: Ints,
    given: Mapping[int, Bytes | Float32s],
    geometry: PatchGeometry,
    outside: float,
) -> Float32s:
    """Return the map patches of n agents: [n, 3, S, S] in [-1, 1].

    Absent is −1, present 1; 0 is unknown. An agent's given patch takes precedence over the raster.

    Args:
        scene: the agents and their raster.
        targets: [n], indices of agents.
        given: agents' own patches by agent index, [3, S, S] in [0, 1].
        geometry: where a patch's pixels lie.
        outside: the value of pixels outside the raster, in [0, 1]: 0 absent, 0.5 unknown.
    """
    patches = np.zeros((len(targets), 3, geometry.size, geometry.size), dtype=np.float32)
    own = np.array([int(target) in given for target in targets], dtype=np.bool_)
    cut = ~own
    if scene.raster is not None and cut.any():
        states, seen = scene.states, targets[cut]
        position, heading = states.position[seen, -1], states.heading[seen, -1]
        patches[cut] = 2 * cut_patches(scene.raster, position, heading, geometry, outside) - 1
    for row in np.flatnonzero(own):
        patches[row] = 2 * given[int(targets[row])].astype(np.float32) - 1
    return patches


def cut_patches(
    raster: Raster, position: Floats, heading: Floats, geometry: PatchGeometry = NEAR, outside: float = 0.0
) -> Float32s:
    """Return map patches of N agents, bilinear between raster pixels.

    A raster of twice the patch's resolution or more is first coarsened to near that resolution, so that thin
    lines remain. The coarse pixels are aligned with the raster, so that a patch does not depend on the other
    agents.

    Positions are subtracted from the raster's origin in float64, and fractions of a pixel count.

    Args:
        raster: the scene's map, any resolution.
        position: [N, 2], m, ground frame.
        heading: [N], rad.
        geometry: geometry of the patches.
        outside: value of pixels outside the raster.

    Returns:
        [N, 3, S, S] in [0, 1].

    Raises:
        ValueError: a position or heading is not finite.
    """
    count = len(position)
    if not (np.isfinite(position).all() and np.isfinite(heading).all()):
        raise ValueError("a map patch needs a finite position and heading")
    layers, rows, columns = raster.layers.shape
    patches = np.full((count, layers, geometry.size, geometry.size), outside, dtype=np.float32)
    # In raster pixels from here on; (row, column) correspond to ground (x, y)
    center = (position - raster.origin) * raster.pixels_per_meter
    zoom = raster.pixels_per_meter / geometry.pixels_per_meter
    reach = geometry.reach * zoom + 1
    on_map = ((center > -reach) & (center < np.array([rows, columns]) - 1 + reach)).all(axis=1)
    if not (on_map.any() and raster.layers.size):
        return patches
    # Only the part that the agents can see is converted to floats
    low = np.maximum(np.floor(center[on_map].min(axis=0) - reach), 0).astype(np.int64)
    high = np.minimum(np.ceil(center[on_map].max(axis=0) + reach) + 1, [rows, columns]).astype(np.int64)
    factor = max(int(zoom), 1)
    low -= low % factor
    pixels = _coarsened(raster.layers[:, low[0] : high[0], low[1] : high[1]], factor)
    if outside:  # an additional layer: the share of a sample that lies on the raster
        pixels = np.concatenate([pixels, np.ones_like(pixels[:1])])
    crop = torch.from_numpy(pixels.astype(np.float32))
    # In coarse pixels, each centred on the raster pixels that it consists of
    coarse = (center[on_map] - low - (factor - 1) / 2) / factor
    seen = functional.grid_sample(
        crop.expand(int(on_map.sum()), -1, -1, -1),  # no copy: all agents share the same pixels
        _grid(zoom / factor, coarse, heading[on_map], (crop.shape[1], crop.shape[2]), geometry),
        mode="bilinear",
        padding_mode="zeros",
        align_corners=False,
    )
    if outside:
        seen = seen[:, :layers] + outside * (1 - seen[:, layers:])
    if on_map.all():
        return seen.numpy()
    patches[on_map] = seen.numpy()
    return patches


def _coarsened(layers: Bytes, factor: int) -> Bytes:
    """Return the layers in coarse pixels of ``factor`` × ``factor``, each the maximum of its raster pixels.

    Samples of a finer raster would lose lines that fall between them.
    """
    if factor == 1:
        return layers
    count, rows, columns = layers.shape
    padded = np.zeros((count, -(-rows // factor) * factor, -(-columns // factor) * factor), dtype=np.uint8)
    padded[:, :rows, :columns] = layers
    # Slice by slice: a maximum over two axes of a reshaped array is ten times slower
    coarse = padded[:, ::factor, ::factor].copy()
    for row in range(factor):
        for column in range(factor):
            np.maximum(coarse, padded[:, row::factor, column::factor], out=coarse)
    return coarse


def _grid(
    scale: float, center: Floats, heading: Floats, shape: tuple[int, int], geometry: PatchGeometry
) -> Tensor:
    """Return the sampling point of each patch pixel in the coordinates of ``grid_sample``: [N, S, S, 2].

    They have the column first, and ∓1 lies half a pixel outside the outermost pixels.

    Args:
        scale: pixels of the sampled image per pixel of the patch.
        center: [N, 2], positions of the agents, pixels.
        heading: [N], rad.
        shape: rows and columns of the sampled image.
        geometry: geometry of the patches.
    """
    cos, sin = scale * np.cos(heading), scale * np.sin(heading)
    # pixel = center + i' (cos, sin) + j' (−sin, cos), with i' and j' relative to the agent's row and column
    ahead, left = np.stack([sin, cos], axis=-1), np.stack([cos, -sin], axis=-1)  # [N, (column, row)]
    half = np.array([shape[1], shape[0]]) / 2
    start = _float32((center[:, ::-1] + 0.5) / half - 1)[:, None]
    index = torch.arange(geometry.size, dtype=torch.float32)[:, None]
    along = start + (index - geometry.rows_behind) * _float32(ahead / half)[:, None]  # [N, S, 2]
    across = (index - geometry.columns_right) * _float32(left / half)[:, None]
    return along[:, :, None] + across[:, None]


def _float32(values: Floats) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))
