"""A roundabout of one lane with four arms, and zebra crossings. Cycles ride on the lane.

Traffic keeps to the right. The arms run along x and y, and the ring is around the origin.
"""

import math

import numpy as np

from cab_forecast.demo.drawing import ROAD_DIVIDER, Painter
from cab_forecast.demo.lines import Floats, Line, arc, fillet, polyline, quarter_turns
from cab_forecast.demo.world import Gate, Kind, Route, World

EDGE = 80.0
"""Distance from the centre to the edges of the map, m."""
_END = 74.0
"""Distance from the centre at which users enter and leave, m."""
_RING = 16.0
"""Radius of the middle of the ring's lane, m."""
_RING_LANE = 5.6
"""m."""
_LANE = 2.0
"""Distance of the lanes' middles from the middle of an arm, m."""
_HALF = 4.2
"""Half the width of an arm, m."""
_JOIN = math.radians(28.0)
"""Angle from an arm to where its lanes join the ring."""
_YIELD, _ZEBRA = 22.5, 31.0
"""Distances of the lines where one yields, and of the zebra crossings, from the centre, m."""
_SPEED, _CYCLING, _WALKING = 10.5, 4.5, 1.3


def roundabout() -> World:
    """Return the roundabout."""
    routes: dict[str, Route] = {}
    for arm in range(4):
        for route in (*_driving(arm), *_walking(arm)):
            routes[route.name] = route
    population: dict[Kind, int] = {"vehicle": 16, "cyclist": 3, "pedestrian": 8}
    return World("roundabout", _map(routes).raster(), routes, population)


def _map(routes: dict[str, Route]) -> Painter:
    painter = Painter((-EDGE, -EDGE), (EDGE, EDGE))
    for route in routes.values():
        if route.kind == "vehicle":
            painter.ribbon(route.line, -_HALF + _LANE, _HALF - _LANE)
    for arm in range(4):
        painter.area(
            quarter_turns([(_RING, -_HALF), (EDGE + 1, -_HALF), (EDGE + 1, _HALF), (_RING, _HALF)], arm)
        )
        painter.stroke(ROAD_DIVIDER, quarter_turns([(_YIELD, 0), (EDGE, 0)], arm))
    full = 2 * math.pi
    painter.area(arc((0.0, 0.0), _RING + _RING_LANE / 2, 0.0, full))
    painter.area(arc((0.0, 0.0), _RING - _RING_LANE / 2, 0.0, full), driveable=False)
    return painter


def _driving(arm: int) -> list[Route]:
    """Return the routes of those who come in on an arm, to each of the others; arm 0 comes from the west."""
    joins, leaves = math.pi + _JOIN, math.pi - _JOIN
    entry = _to_ring(joins)
    routes = []
    for exits in range(1, 4):  # 1: the next arm, on the right
        turn = (leaves - joins + exits * math.pi / 2) % (2 * math.pi)
        ring = arc((0.0, 0.0), _RING, joins, turn)
        out = quarter_turns(_to_ring(joins)[::-1] * (1, -1), exits)
        line = Line(quarter_turns(polyline(entry, ring, out), arm))
        gates = (
            Gate(_END - _ZEBRA - 2.0),
            Gate(_END - _YIELD),
            Gate(line.length - _END + _ZEBRA - 2.0),
        )
        share = (0.8, 1.0, 0.7)[exits - 1]
        lane = f"lane-{arm}"
        routes += [
            Route(f"drive-{arm}-{exits}", "vehicle", line, _SPEED, 0, gates, lane, share),
            Route(
                f"cycle-{arm}-{exits}", "cyclist", line, _CYCLING, 0, gates, lane, share, spread=(-0.6, -0.4)
            ),
        ]
    return routes


def _to_ring(angle: float) -> Floats:
    """Return the way [V, 2] from the western edge to the ring, which it joins at an angle."""
    end = _RING * np.array([math.cos(angle), math.sin(angle)])
    ahead = np.array([-math.sin(angle), math.cos(angle)])
    corner = end - ahead * (end[1] + _LANE) / ahead[1]
    return polyline((-_END, -_LANE), fillet((-_ZEBRA, -_LANE), corner.tolist(), end.tolist()), end)


def _walking(arm: int) -> list[Route]:
    """Return the ways across an arm on its zebra crossing, in both directions."""
    routes = []
    for name, points in (
        ("on", [(-_ZEBRA, -_END), (-_ZEBRA, _END)]),
        ("back", [(-_ZEBRA, _END), (-_ZEBRA, -_END)]),
    ):
        line = Line(quarter_turns(points, arm))
        kerb = (Gate(_END - _HALF - 0.8),)
        routes.append(Route(f"walk-{name}-{arm}", "pedestrian", line, _WALKING, 3, kerb, spread=(-1.1, -0.4)))
    return routes
