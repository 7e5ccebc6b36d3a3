"""nuscenes-devkit's off-road rate (``eval/prediction/metrics.py``, ``OffRoadRate``), for comparison.

It differs from ``offroad`` in three ways: the modes of an instance count alike, whatever their
probabilities; a cubic smoothing spline of 200 points through a trajectory is looked at instead of its
points (also those between them, then, and close to them rather than at them); and a point belongs to the
pixel that its coordinates are cut to, not to the nearest. On the devkit's own mask (driveable area only, 10
pixels a metre, the whole city, origin 0; its rows run along y, ours along x) the figures are equal.

Needs scipy, which comes with the devkit and not with this package.
"""

import importlib

import numpy as np

from model.arrays import Floats
from model.metrics.offroad import DRIVEABLE_LAYER
from model.scenes.scene import Raster

POINTS = 200
"""On a spline."""
SMOOTHING_M2 = 0.1
"""Sum of squared distances by which the spline may miss the trajectory's points."""


def off_road_rate_devkit(raster: Raster, modes: Floats) -> float:
    """The share of one instance's modes that leave the driveable area.

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
    """[T, 2] → [200, 2], or the distinct points where there are three or fewer."""
    points = np.array(list(dict.fromkeys(map(tuple, trajectory.tolist()))))
    if len(points) <= 3:
        return points
    interpolate = importlib.import_module("scipy.interpolate")
    knots, _ = interpolate.splprep([points[:, 0], points[:, 1]], k=3, s=SMOOTHING_M2)
    return np.stack(interpolate.splev(np.linspace(0, 1, POINTS), knots), axis=-1)
