"""Conditions under which an agent is a donor of context for another one.

A donor drives about as fast as the agent, so that its map and its neighbours are likely ones; there is road
under the agent's past, and neighbours do not run into that.
"""

from typing import Final

import numpy as np

from model.arrays import Bools, Bytes, Float32s, Floats
from model.geometry import rotate
from model.metrics.offroad import DRIVEABLE_LAYER
from model.scenes.raster import PatchGeometry

LIKE_SPEED: Final = 1.0
"""m/s by which the speeds of agent and donor may differ."""
NEIGHBORS_M: Final = 60.0
"""Distance within which neighbours are exchanged, m."""
LENGTH_M: Final = 5.0
"""m along the agent, between centres, within which a neighbour may overlap with it."""
WIDTH_M: Final = 2.0
"""m across the agent, likewise."""


def alike(speeds: Floats, speed: float) -> Bools:
    """Return which speeds are like another one, all in m/s: [n]; never for an unknown one (NaN)."""
    return np.asarray(np.abs(speeds - speed) <= LIKE_SPEED)


def overlaps(neighbors: Floats, past: Floats, heading: Floats) -> Bools:
    """Return which neighbours overlap with an agent at any frame: [m].

    Args:
        neighbors: [m, F, 2], m, NaN where not seen.
        past: [F, 2], m, positions of the agent, likewise.
        heading: [F], rad, headings of the agent.
    """
    ahead, left = np.moveaxis(np.abs(rotate(neighbors - past, -heading)), -1, 0)
    return np.asarray(((ahead < LENGTH_M) & (left < WIDTH_M)).any(axis=1))  # NaN does not


def is_driveable(patch: Bytes | Float32s, geometry: PatchGeometry, points: Floats) -> bool:
    """Return whether a patch shows no point beside the driveable area; points outside of it do not count.

    Args:
        patch: [3, S, S] in [0, 1], 0.5 unknown.
        geometry: geometry of the patch.
        points: [n, 2], m ahead and to the left; NaN where unknown.
    """
    pixels = points[np.isfinite(points).all(axis=1)] * geometry.pixels_per_meter
    own = np.array([geometry.rows_behind, geometry.columns_right])
    pixels = np.rint(pixels + own).astype(np.int64)
    row, column = pixels[((pixels >= 0) & (pixels < geometry.size)).all(axis=1)].T
    return bool((patch[DRIVEABLE_LAYER, row, column] >= 0.5).all())
