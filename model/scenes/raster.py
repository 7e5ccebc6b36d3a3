"""Map patches of agents, cut from the raster of a scene.

Geometry as in Trajectron++ (Salzmann et al. 2020) on nuScenes: a patch is 100 × 100 pixels at 3 pixels a
metre in the agent's frame; it begins 10 pixels behind the agent and 50 pixels to its right. Element (row i,
column j) shows the ground point ``position + R(heading) · ((i − 10) / 3, (j − 50) / 3)`` m: rows go ahead,
columns to the left.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from model.arrays import Bools, Bytes, Float32s, Floats, Ints
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


_UNKNOWN = 0.5
"""Value of what is not known, in [0, 1]."""
_FAR_AWAY = 1e6
"""Pixels from an image at which nothing of it is seen."""


@dataclass(frozen=True)
class MapView:
    """The map as N agents see it, before their patches are cut.

    A patch has 120 kB, and the view a few bytes an agent beside the raster, so agents wait for their forward
    as views.
    """

    geometry: PatchGeometry
    """Geometry of the patches."""
    outside: float
    """Value of pixels outside the raster, in [0, 1]: 0 absent, 0.5 unknown."""
    layers: Bytes | None
    """[3, rows, columns], 0 or 1, the part of the raster that the agents see; None: there is no raster."""
    scale: float
    """Pixels of ``layers`` per pixel of a patch."""
    center: Floats
    """[N, 2], positions in ``layers``, pixels; NaN for an agent that sees nothing of them."""
    heading: Floats
    """[N], rad."""
    given: Mapping[int, Bytes | Float32s]
    """Agents' own patches by row, each [3, S, S] in [0, 1]; they take precedence over the raster."""

    def __len__(self) -> int:
        return len(self.center)

    def __getitem__(self, agents: slice) -> "MapView":
        """Return the view of successive agents."""
        start, stop, _ = agents.indices(len(self))
        given = {row - start: patch for row, patch in self.given.items() if start <= row < stop}
        return replace(self, center=self.center[agents], heading=self.heading[agents], given=given)

    def cut(self) -> Float32s:
        """Return the patches of the agents: [N, 3, S, S] in [-1, 1], 0 where nothing is known.

        They are bilinear between pixels. Absent is −1, present 1.
        """
        shape = (len(self), 3, self.geometry.size, self.geometry.size)
        sees = np.isfinite(self.center[:, 0])
        if self.layers is None or not sees.any():
            patches = np.full(shape, 0.0 if self.layers is None else 2 * self.outside - 1, dtype=np.float32)
        elif sees.all():
            patches = self._sample(self.layers, self.center, self.heading)
        else:
            patches = np.full(shape, 2 * self.outside - 1, dtype=np.float32)
            patches[sees] = self._sample(self.layers, self.center[sees], self.heading[sees])
        for row, patch in self.given.items():
            patches[row] = 2 * patch.astype(np.float32) - 1
        return patches

    def _sample(self, layers: Bytes, center: Floats, heading: Floats) -> Float32s:
        image = np.empty(layers.shape, dtype=np.float32)
        _draw(layers, self.outside, image)
        # No copy: all agents share the same pixels
        images = torch.from_numpy(image).expand(len(center), -1, -1, -1)
        scales = np.full(len(center), self.scale)
        return _sample(images, scales, center, heading, self.geometry, self.outside)


def cut_views(views: Sequence[MapView]) -> list[Float32s]:
    """Return the patches of each view, see ``MapView.cut``.

    Views of a single agent are cut together, which takes a fraction of the time.

    Args:
        views: views of one geometry, and of one value outside.
    """
    single = [view for view in views if len(view) == 1 and view.layers is not None and not view.given]
    if len(single) < 2:
        return [view.cut() for view in views]
    together = iter(_cut_single(single))
    waiting = {id(view) for view in single}
    return [next(together)[None] if id(view) in waiting else view.cut() for view in views]


def _cut_single(views: Sequence[MapView]) -> Float32s:
    """Return the patches of n views of one agent each on a raster: [n, 3, S, S]."""
    parts = [view.layers for view in views if view.layers is not None]
    rows, columns = (max(1, *(part.shape[axis] for part in parts)) for axis in (1, 2))
    images = np.zeros((len(parts), 3, rows, columns), dtype=np.float32)
    for image, part in zip(images, parts, strict=True):
        _draw(part, views[0].outside, image[:, : part.shape[1], : part.shape[2]])
    center = np.concatenate([view.center for view in views])
    return _sample(
        torch.from_numpy(images),
        np.array([view.scale for view in views]),
        np.where(np.isfinite(center), center, -_FAR_AWAY),
        np.concatenate([view.heading for view in views]),
        views[0].geometry,
        views[0].outside,
    )


def _draw(layers: Bytes, outside: float, image: Float32s) -> None:
    """Draw layers of 0 and 1 as −1 and 1, relative to the value outside: samples there count as zero."""
    np.take(np.array([-2 * outside, 2 - 2 * outside], dtype=np.float32), layers, out=image, mode="clip")


def _sample(
    images: Tensor, scale: Floats, center: Floats, heading: Floats, geometry: PatchGeometry, outside: float
) -> Float32s:
    """Return patches of n agents, bilinear between the pixels of their images: [n, 3, S, S] in [-1, 1].

    Args:
        images: [n, 3, rows, columns], from ``_draw``.
        scale: [n], pixels of an image per pixel of the patch.
        center: [n, 2], positions of the agents, pixels.
        heading: [n], rad.
        geometry: geometry of the patches.
        outside: value of pixels outside the images, in [0, 1].
    """
    grid = torch.from_numpy(_grid(scale, center, heading, (images.shape[2], images.shape[3]), geometry))
    sampled: Float32s = functional.grid_sample(
        images, grid, mode="bilinear", padding_mode="zeros", align_corners=False
    ).numpy()
    if outside != _UNKNOWN:
        sampled += np.float32(2 * outside - 1)
    return sampled


def map_view(
    scene: Scene,
    targets: Ints,
    given: Mapping[int, Bytes | Float32s],
    geometry: PatchGeometry,
    outside: float,
) -> MapView:
    """Return the map as n agents see it.

    Args:
        scene: the agents and their raster.
        targets: [n], indices of agents.
        given: agents' own patches by agent index, [3, S, S] in [0, 1].
        geometry: where a patch's pixels lie.
        outside: the value of pixels outside the raster, in [0, 1]: 0 absent, 0.5 unknown.

    Raises:
        ValueError: a position or heading is not finite.
    """
    own = {row: given[target] for row, target in enumerate(targets.tolist()) if target in given}
    if scene.raster is None:
        unseen = np.full((len(targets), 2), np.nan)
        return MapView(geometry, outside, None, 1.0, unseen, np.zeros(len(targets)), own)
    states = scene.states
    position, heading = states.position[targets, -1], states.heading[targets, -1]
    return replace(raster_view(scene.raster, position, heading, geometry, outside), given=own)


def map_patches(
    scene: Scene,
    targets: Ints,
    given: Mapping[int, Bytes | Float32s],
    geometry: PatchGeometry,
    outside: float,
) -> Float32s:
    """Return the map patches of n agents: [n, 3, S, S] in [-1, 1]; see ``map_view`` and ``MapView.cut``."""
    return map_view(scene, targets, given, geometry, outside).cut()


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
    patches = raster_view(raster, position, heading, geometry, outside).cut()
    patches += 1
    patches /= 2
    return patches.clip(0, 1, out=patches)  # rounding


def coarsening(pixels_per_meter: float, geometry: PatchGeometry) -> int:
    """Return the side of the coarse pixels, in pixels of a raster, from which patches of it are cut.

    They are counted from the raster's corner: a part of a raster gives the same patches as the whole if it
    begins at a multiple of this.

    Args:
        pixels_per_meter: resolution of the raster.
        geometry: geometry of the patches.
    """
    return max(int(pixels_per_meter / geometry.pixels_per_meter), 1)


def raster_view(
    raster: Raster, position: Floats, heading: Floats, geometry: PatchGeometry, outside: float
) -> MapView:
    """Return the view of N agents on a raster; ``cut_patches`` explains the arguments and what it raises."""
    if not (np.isfinite(position).all() and np.isfinite(heading).all()):
        raise ValueError("a map patch needs a finite position and heading")
    size = np.array(raster.layers.shape[1:])
    # In raster pixels from here on; (row, column) correspond to ground (x, y)
    center = (position - raster.origin) * raster.pixels_per_meter
    zoom = raster.pixels_per_meter / geometry.pixels_per_meter
    factor = coarsening(raster.pixels_per_meter, geometry)
    reach = geometry.reach * zoom + 1
    on_map: Bools = np.all((center > -reach) & (center < size - 1 + reach), axis=1)
    if on_map.any() and raster.layers.size:
        # Only the part that the agents can see is kept
        low = np.maximum(np.floor(center[on_map].min(axis=0) - reach), 0).astype(np.int64)
        high = np.minimum(np.ceil(center[on_map].max(axis=0) + reach) + 1, size).astype(np.int64)
        low -= low % factor
        layers = _coarsened(raster.layers[:, low[0] : high[0], low[1] : high[1]], factor)
        # In coarse pixels, each centred on the raster pixels that it consists of
        center = (center - low - (factor - 1) / 2) / factor
    else:
        layers = raster.layers[:, :0, :0]
    sees = on_map if layers.size else np.zeros_like(on_map)
    center = np.where(sees[:, None], center, np.nan)
    return MapView(geometry, outside, layers, zoom / factor, center, heading, {})


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
    scale: Floats, center: Floats, heading: Floats, shape: tuple[int, int], geometry: PatchGeometry
) -> Float32s:
    """Return the sampling point of each patch pixel in the coordinates of ``grid_sample``: [N, S, S, 2].

    They have the column first, and ∓1 lies half a pixel outside the outermost pixels. Computed in numpy: each
    operation of torch, however small, hands the interpreter over to threads that wait for it.

    Args:
        scale: [N], pixels of the sampled image per pixel of the patch.
        center: [N, 2], positions of the agents, pixels.
        heading: [N], rad.
        shape: rows and columns of the sampled image.
        geometry: geometry of the patches.
    """
    cos, sin = scale * np.cos(heading), scale * np.sin(heading)
    # pixel = center + i' (cos, sin) + j' (−sin, cos), with i' and j' relative to the agent's row and column
    ahead, left = np.stack([sin, cos], axis=1), np.stack([cos, -sin], axis=1)  # [N, (column, row)]
    half = np.array([shape[1], shape[0]]) / 2
    start = ((center[:, ::-1] + 0.5) / half - 1).astype(np.float32)[:, :, None]
    index = np.arange(geometry.size, dtype=np.float32)
    along = start + (index - geometry.rows_behind) * (ahead / half).astype(np.float32)[:, :, None]
    across = (index - geometry.columns_right) * (left / half).astype(np.float32)[:, :, None]
    # The two coordinates lie in planes of their own: sums of long rows take a third of the time
    grid: Float32s = (along[..., :, None] + across[..., None, :]).transpose(0, 2, 3, 1)
    return grid


def reduced(layers: Bytes, max_pixels: int) -> tuple[Bytes, int]:
    """Return layers of at most ``max_pixels`` pixels, and the pixels along the side of one of theirs.

    A pixel is set where any of its own is, so that dividers do not vanish.

    Args:
        layers: [L, rows, columns].
        max_pixels: number of pixels, about.
    """
    count, rows, columns = layers.shape
    step = math.ceil(math.sqrt(rows * columns / max_pixels))
    if step <= 1:
        return layers, 1
    padded = np.pad(layers, ((0, 0), (0, -rows % step), (0, -columns % step)))
    blocks = padded.reshape(count, padded.shape[1] // step, step, padded.shape[2] // step, step)
    smaller: Bytes = blocks.max(axis=(2, 4))
    return smaller, step
