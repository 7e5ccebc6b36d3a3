"""Roads in a scene's own frame, with right-hand traffic; each function returns one, to be painted."""

from functools import partial

import numpy as np

from model.arrays import Bools, Floats
from tests.cases.case import Road

_ROAD_DIVIDER_WIDTH = 0.5
_LANE_DIVIDER_WIDTH = 0.4


def straight(lanes: int, lane_width: float) -> Road:
    """Return a road along x, with its centre line at y = 0.

    Args:
        lanes: lanes per direction.
        lane_width: width of a lane, m.
    """
    return lambda x, y: _across(y, lanes, lane_width)


def curve(radius: float, lanes: int, lane_width: float, arc: float = 2.2) -> Road:
    """Return a road that runs along x, turns left from x = 0 on, and then continues straight.

    Args:
        radius: radius of the centre line, m.
        lanes: lanes per direction.
        lane_width: width of a lane, m.
        arc: angle of the turn, rad, less than π.
    """

    def paint(x: Floats, y: Floats) -> Bools:
        angle = np.arctan2(x, radius - y)
        bent = radius - np.hypot(x, radius - y)
        before = np.where(x < 0, y, np.inf)
        within = np.where((angle >= 0) & (angle < arc), bent, np.inf)
        # After the arc: ahead of its end, in the frame of that end
        cos, sin = np.cos(arc), np.sin(arc)
        dx, dy = x - radius * sin, y - radius * (1 - cos)
        after = np.where(cos * dx + sin * dy >= 0, cos * dy - sin * dx, np.inf)
        offsets = np.stack([before, within, after])
        nearest = np.take_along_axis(offsets, np.abs(offsets).argmin(0)[None], axis=0)[0]
        return _across(nearest, lanes, lane_width)

    return paint


def junction(lanes: int, lane_width: float, kerb_radius: float) -> Road:
    """Return two roads that cross at the origin, along x and along y, without markings where they meet.

    Args:
        lanes: lanes per direction of each road.
        lane_width: width of a lane, m.
        kerb_radius: radius of the rounded corners, m.
    """
    half = lanes * lane_width
    stop = half + kerb_radius

    def paint(x: Floats, y: Floats) -> Bools:
        along_x, along_y = _across(y, lanes, lane_width), _across(x, lanes, lane_width)
        layers = np.where(np.abs(x) > stop, along_x, False) | np.where(np.abs(y) > stop, along_y, False)
        inside = (np.abs(x) <= stop) & (np.abs(y) <= stop)
        beyond_kerb = np.hypot(np.abs(x) - stop, np.abs(y) - stop) >= kerb_radius
        layers[0] = along_x[0] | along_y[0] | (inside & beyond_kerb)
        return layers

    return paint


def _across(offset: Floats, lanes: int, lane_width: float) -> Bools:
    """Return the layers [3, ...] at points ``offset`` m to the left of a road's centre line."""
    line = partial(_line, np.abs(offset))
    dividers = np.zeros(offset.shape, dtype=np.bool_)
    for lane in range(1, lanes):
        dividers |= line(lane * lane_width, _LANE_DIVIDER_WIDTH)
    return np.stack([np.abs(offset) <= lanes * lane_width, line(0.0, _ROAD_DIVIDER_WIDTH), dividers])


def _line(distance: Floats, at: float, width: float) -> Bools:
    return np.asarray(np.abs(distance - at) <= width / 2)
