"""Map of the demo scene: two roads with two lanes each way, right-hand traffic, and one lay-by."""

import numpy as np
import numpy.typing as npt

from cab.forecast.v1.prediction_service_pb2 import SceneRaster
from cab_forecast.requests import PIXELS_PER_METER, scene_raster

LANE_WIDTH = 3.5
"""Metres."""
ROAD_HALF_WIDTH = 2 * LANE_WIDTH
CORNER_RADIUS = 6.0
"""Radius of the rounded kerb, m."""
STOP_LINE = ROAD_HALF_WIDTH + CORNER_RADIUS + 1.5
"""Distance from the centre at which painted lines end, m."""
LAY_BY_CENTER = (34.0, -ROAD_HALF_WIDTH - 1.25)
"""Ground position, m, south of the eastern arm."""
EDGE = 60.0
"""Distance from the centre to the edges of the raster, m."""

_LAY_BY_SIZE = (22.0, 2.5)
_ROAD_DIVIDER_WIDTH = 0.7
_LANE_DIVIDER_WIDTH = 0.4

_Floats = npt.NDArray[np.float64]
_Bools = npt.NDArray[np.bool_]


def crossing_raster() -> SceneRaster:
    """Build the map, centred on the origin of the ground frame; the roads run along x and y."""
    pixels = round(2 * EDGE * PIXELS_PER_METER)
    ground = -EDGE + np.arange(pixels) / PIXELS_PER_METER
    x, y = np.meshgrid(ground, ground, indexing="ij")
    layers = np.stack([driveable(x, y), _lines(x, y, 0.0, _ROAD_DIVIDER_WIDTH), _lane_dividers(x, y)])
    return scene_raster(layers, (-EDGE, -EDGE), PIXELS_PER_METER, encoding="png")


def driveable(x: _Floats, y: _Floats) -> _Bools:
    """Return which ground points belong to the roads; any shape, m."""
    across_x, across_y = np.abs(y), np.abs(x)
    roads = (across_x <= ROAD_HALF_WIDTH) | (across_y <= ROAD_HALF_WIDTH)
    corner = ROAD_HALF_WIDTH + CORNER_RADIUS
    kerb = np.hypot(across_x - corner, across_y - corner) >= CORNER_RADIUS
    rounded = (across_x <= corner) & (across_y <= corner) & kerb
    length, width = _LAY_BY_SIZE
    lay_by = (np.abs(x - LAY_BY_CENTER[0]) <= length / 2) & (np.abs(y - LAY_BY_CENTER[1]) <= width / 2)
    return np.asarray(roads | rounded | lay_by)


def _lane_dividers(x: _Floats, y: _Floats) -> _Bools:
    return _lines(x, y, LANE_WIDTH, _LANE_DIVIDER_WIDTH) | _lines(x, y, -LANE_WIDTH, _LANE_DIVIDER_WIDTH)


def _lines(x: _Floats, y: _Floats, offset: float, width: float) -> _Bools:
    """Return lines along all four arms, at an offset from their middle; the crossing itself has none."""
    along_x = (np.abs(y - offset) <= width / 2) & (np.abs(x) >= STOP_LINE)
    along_y = (np.abs(x - offset) <= width / 2) & (np.abs(y) >= STOP_LINE)
    return np.asarray(along_x | along_y)
