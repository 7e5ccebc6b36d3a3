"""Off-road rates: share of trajectories that leave the driveable area (OffR; Ben-Younes et al. 2022, sec. 4).

A point is off the road where the nearest pixel of the driveable layer is 0, and outside the raster; a
trajectory is off the road if one of its T points is. At 3 pixels a metre, edges are accurate to 0.17 m.
``offroad_devkit`` has nuscenes-devkit's definition, which differs.
"""

from collections.abc import Sequence

import numpy as np

from model.arrays import Bools, Floats
from model.scenes.scene import Raster

DRIVEABLE_LAYER = 0


def driveable(raster: Raster, points: Floats) -> Bools:
    """Return whether points lie on the driveable area: [...]; points that are not finite do not.

    Args:
        raster: the scene's map.
        points: [..., 2], m, ground frame.
    """
    layer = raster.layers[DRIVEABLE_LAYER]
    if not layer.size:
        return np.zeros(points.shape[:-1], dtype=np.bool_)
    rows, columns = layer.shape
    row, column = (
        np.floor((points[..., axis] - raster.origin[axis]) * raster.pixels_per_meter + 0.5) for axis in (0, 1)
    )
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)  # NaN is not
    index = np.where(inside, row * columns + column, 0).astype(np.int64)
    return np.asarray((layer.reshape(-1)[index] != 0) & inside)


def off_road(raster: Raster, trajectories: Floats) -> Floats:
    """Return whether trajectories leave the driveable area at any of their points.

    Args:
        raster: the scene's map.
        trajectories: [..., T, 2], m, ground frame.

    Returns:
        [...], 1 or 0; NaN where a point is not finite.
    """
    known = np.isfinite(trajectories).all(axis=(-2, -1))
    leaves = ~driveable(raster, trajectories).all(axis=-1)
    return np.where(known, leaves, np.nan)


def off_road_of_each(rasters: Sequence[Raster | None], trajectories: Floats) -> Floats:
    """Return ``off_road`` of instances on maps of their own.

    Args:
        rasters: N, one an instance (instances of one scene may share one); None: no map.
        trajectories: [N, ..., T, 2], m, ground frame.

    Returns:
        [N, ...]; NaN without a map.

    Raises:
        ValueError: the number of rasters is not N.
    """
    if len(rasters) != len(trajectories):
        raise ValueError(f"{len(trajectories)} instances need as many rasters, not {len(rasters)}")
    result = np.full(trajectories.shape[:-2], np.nan)
    rows: dict[int, list[int]] = {}
    for n, raster in enumerate(rasters):
        rows.setdefault(id(raster), []).append(n)
    for indices in rows.values():
        raster = rasters[indices[0]]
        if raster is not None:
            result[indices] = off_road(raster, trajectories[indices])
    return result


def expected_off_road(rasters: Sequence[Raster | None], samples: Floats) -> Floats:
    """Return OffR-f, the share of trajectories drawn from the forecast that leave the driveable area.

    Args:
        rasters: N, one an instance; None: no map.
        samples: [N, S, T, 2], m, ground frame.

    Returns:
        [N], 0 … 1; NaN without a map, or where a sample is not finite.
    """
    return np.asarray(off_road_of_each(rasters, samples).mean(axis=1))
