"""A motorway in a wide bend: three lanes with an entry and an exit, and three lanes the other way.

Traffic keeps to the right.
"""

import numpy as np

from cab_forecast.demo.drawing import LANE_DIVIDER, ROAD_DIVIDER, Painter
from cab_forecast.demo.lines import STEP, Floats, Line, ease
from cab_forecast.demo.world import Kind, Lanes, Route, World

LENGTH = 600.0
"""m."""
_LANE = 3.6
"""Width of a lane, m."""
_MEDIAN = 2.0
"""Distance from the middle of the road to its lanes, m."""
_SHOULDER = 2.5
"""m."""
_BEND = 1 / 1500.0
"""Curvature, 1/m."""
_ENTRY, _MERGED = 130.0, 370.0
"""Places between which the entry runs beside the right lane, m."""
_EXIT = 430.0
"""Place at which the exit leaves the right lane, m."""
_RAMP = 16.0
"""Distance of the ramps' ends from the right lane, m."""
_BEYOND = 10.0
"""Length of the road beyond the places where users enter and leave, m."""
_LANES = ("right", "middle", "left")
_SPEEDS = (24.0, 29.0, 34.0)
_RAMP_SPEED = 24.0


def highway() -> World:
    """Return the motorway."""
    routes: dict[str, Route] = {}
    for number, (name, speed) in enumerate(zip(_LANES, _SPEEDS, strict=True)):
        aside = -_MEDIAN - _LANE * (2.5 - number)
        routes[name] = Route(name, "vehicle", Line(_beside(aside)), speed, share=(0.6, 1.0, 1.0)[number])
        back = f"back-{name}"
        routes[back] = Route(back, "vehicle", Line(_beside(-aside)[::-1]), speed, share=0.7)
    right = -_MEDIAN - _LANE * 2.5
    routes["entry"] = Route("entry", "vehicle", Line(_entry(right)), _RAMP_SPEED, share=0.6, stops=True)
    routes["exit"] = Route("exit", "vehicle", Line(_exit(right)), 24.0, share=0.4)
    population: dict[Kind, int] = {"vehicle": 36}
    lanes = (
        Lanes(("entry", *_LANES), "entry", _ENTRY + 5.0, LENGTH - 60.0),
        Lanes(tuple(f"back-{name}" for name in _LANES), "", 20.0, LENGTH - 60.0),
    )
    return World("highway", _map(routes).raster(), routes, population, lanes=lanes)


def _map(routes: dict[str, Route]) -> Painter:
    line = Line(_beside(0.0, _BEYOND))
    edge = _MEDIAN + 3 * _LANE + _SHOULDER
    low = line.points.min(axis=0) - np.array([0.0, edge + _RAMP + 4])
    high = line.points.max(axis=0) + np.array([0.0, edge + 4])
    painter = Painter((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))
    for side in (-1, 1):
        painter.ribbon(line, *sorted((side * (_MEDIAN - 1.0), side * edge)))
        for number in (1, 2):
            painter.stroke(LANE_DIVIDER, line.beside(side * (_MEDIAN + number * _LANE)))
        for away in (_MEDIAN, _MEDIAN + 3 * _LANE):
            painter.stroke(ROAD_DIVIDER, line.beside(side * away))
    right = -_MEDIAN - _LANE * 2.5
    for ramp in (_entry(right, _BEYOND), _exit(right, _BEYOND)):
        painter.ribbon(Line(ramp), -_LANE / 2 - 0.8, _LANE / 2)
    first, last = (round((place + _BEYOND) / STEP) for place in (_ENTRY, _MERGED))
    painter.stroke(LANE_DIVIDER, line.beside(-_MEDIAN - 3 * _LANE)[first:last])
    return painter


def _places(beyond: float = 0.0) -> Floats:
    """Return places along the middle of the road, and as far beyond its ends, m."""
    return np.arange(-beyond, LENGTH + beyond + STEP, STEP)


def _beside(left: float | Floats, beyond: float = 0.0) -> Floats:
    """Return points [L, 2] beside the middle of the road, at its places."""
    angle = (_places(beyond) - LENGTH / 2) * _BEND
    middle = np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1) / _BEND
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    points: Floats = middle + normal * np.reshape(left, (-1, 1))
    return points


def _entry(right: float, beyond: float = 0.0) -> Floats:
    """Return the ramp that comes up to the right lane, and runs beside it until it ends."""
    near = ease((_places(beyond) - (_ENTRY - 110.0)) / 110.0)
    way = _beside(right - _LANE - _RAMP * (1 - near), beyond)
    return way[round(40.0 / STEP) : round((_MERGED + 2 * beyond) / STEP)]


def _exit(right: float, beyond: float = 0.0) -> Floats:
    """Return the right lane up to the exit, and the ramp that leads away."""
    return _beside(right - _RAMP * ease((_places(beyond) - _EXIT) / 140.0), beyond)
