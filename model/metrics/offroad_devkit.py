"""nuscenes-devkit's off-road rate (``eval/prediction/metrics.py``, ``OffRoadRate``), for comparison.

It differs from ``offroad`` in three ways. The modes of an instance have equal weight, whatever their
probabilities. Instead of a trajectory's points, 200 points on a cubic smoothing spline through them are
tested, which lie also between the points, and only close to them. And coordinates are truncated to a pixel,
not rounded to the nearest. On the devkit's own mask (driveable area only, 10 pixels a metre, the whole city,
origin 0; its rows run along y, ours along x) the figures are equal.

This needs scipy, which comes with the devkit and not with this package.
"""

import importlib

import numpy as np

from model.arrays import Floats
from model.metrics.offroad import DRIVEABLE_LAYER
from model.scenes.scene import Raster

POINTS = 200
"""Points on a spline."""
SMOOTHING_M2 = 0.1
"""Maximum sum of squared distances between the spline and the trajectory's points."""


def off_road_rate_devkit(raster: Raster, modes: Floats) -> float:
    """Return the share of one instance's modes that leave the driveable area.

    Args:
        raster: the map.
        modes: [K, T, 2], m, ground frame.

    Returns:
        0 … 1; NaN where a point is not finite (the devkit raises).

    Raises:
        ImportError: scipy is not installed.
    """
    if not np.isfinite(modes).all():
        return float("nan")
    layer = raster.layers[DRIVEABLE_LAYER]
    violations = 0
    for mode in modes:
        pixel = ((_spline(mode) - raster.origin) * raster.pixels_per_meter).astype(np.int64)  # towards zero
        inside = bool(((pixel >= 0) & (pixel < layer.shape)).all())
        violations += not (inside and bool(layer[pixel[:, 0], pixel[:, 1]].all()))
    return violations / len(modes)


def _spline(trajectory: Floats) -> Floats:
    """Return points on a spline: [T, 2] → [200, 2], or the distinct points if there are three or fewer."""
    points = np.array(list(dict.fromkeys(map(tuple, trajectory.tolist()))))
    if len(points) <= 3:
        return points
    interpolate = importlib.import_module("scipy.interpolate")
    knots, _ = interpolate.splprep([points[:, 0], points[:, 1]], k=3, s=SMOOTHING_M2)
    return np.stack(interpolate.splev(np.linspace(0, 1, POINTS), knots), axis=-1)
