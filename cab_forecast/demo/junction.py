"""A junction with traffic lights: two roads with two lanes and a cycle lane each way, and a lay-by.

Traffic keeps to the right. The roads run along x and y and cross at the origin.
"""

from cab_forecast.demo.drawing import LANE_DIVIDER, ROAD_DIVIDER, Painter
from cab_forecast.demo.lines import Line, change_over, fillet, polyline, quarter_turns
from cab_forecast.demo.world import Gate, Kind, Route, Signals, World

EDGE = 90.0
"""Distance from the centre to the edges of the map, m."""
LANE = 3.5
"""Width of a lane, m."""
_END = 84.0
"""Distance from the centre at which users enter and leave, m."""
_INNER, _OUTER, _CYCLE = LANE / 2, LANE * 3 / 2, 2 * LANE + 0.75
"""Distances of the lanes' middles from the middle of the road, m."""
_HALF = 2 * LANE + 1.8
"""Half the width of a road, m."""
_KERB = 6.0
"""Radius of the corners, m."""
_WALK = 15.0
"""Distance of the pedestrians' ways from the middle of the roads, m."""
_STOP = 18.0
"""Distance of the stop lines from the centre, m."""
_BAY = _HALF + 1.35
"""Distance of the middle of the lay-by from the middle of its road, m."""
_BAYS = (38.0, 54.0)
"""Places of parked vehicles, m east of the centre."""
_LEFT = 8.5
"""Distance from the centre at which left turns begin and end, m."""
_SPEED, _CYCLING, _WALKING = 13.0, 5.0, 1.35
_TURNS = (("straight", 0), ("left", 1), ("right", -1))


def junction() -> World:
    """Return the junction."""
    routes: dict[str, Route] = {}
    for arm in range(4):
        for route in (*_driving(arm), *_cycling(arm), *_walking(arm)):
            routes[route.name] = route
    for route in _parking():
        routes[route.name] = route
    green = {"east-west": (0.0, 18.0), "north-south": (23.0, 41.0)}
    walk = {"walk-east-west": (0.5, 6.0), "walk-north-south": (23.5, 29.0)}
    cycle = {"cycle-east-west": (0.0, 13.0), "cycle-north-south": (23.0, 36.0)}
    signals = Signals(46.0, green | walk | cycle, dict.fromkeys(green, 3.0) | dict.fromkeys(cycle, 2.0))
    population: dict[Kind, int] = {"vehicle": 24, "cyclist": 4, "pedestrian": 10}
    return World("junction", _map().raster(), routes, population, signals)


def _map() -> Painter:
    painter = Painter((-EDGE, -EDGE), (EDGE, EDGE))
    corner = _HALF + _KERB
    for arm in range(4):
        painter.area(quarter_turns([(0, -_HALF), (EDGE + 1, -_HALF), (EDGE + 1, _HALF), (0, _HALF)], arm))
        kerb = fillet((corner, _HALF), (_HALF, _HALF), (_HALF, corner))
        painter.area(quarter_turns(polyline((0, 0), (corner, 0), kerb, (0, corner)), arm))
        painter.stroke(ROAD_DIVIDER, quarter_turns([(_STOP, 0), (EDGE, 0)], arm))
        for aside in (-2 * LANE, -LANE, LANE, 2 * LANE):
            painter.stroke(LANE_DIVIDER, quarter_turns([(_STOP, aside), (EDGE, aside)], arm))
    first, last = _BAYS[0] - 14.0, _BAYS[1] + 14.0
    edge = -_BAY - 1.35
    painter.area([(first - 4, -_HALF), (first, edge), (last, edge), (last + 4, -_HALF)])
    return painter


def _driving(arm: int) -> list[Route]:
    """Return the routes of vehicles that come in on an arm: straight on both lanes, left, right."""
    group = "east-west" if arm % 2 == 0 else "north-south"
    routes = []
    for turn, quarter in _TURNS:
        for lane, aside in (("inner", _INNER), ("outer", _OUTER)):
            if (turn, lane) in (("left", "outer"), ("right", "inner")):
                continue
            # The western arm leads eastwards, on the right
            way = polyline((-_END, -aside), (_END, -aside))
            if quarter:
                out = quarter * aside  # the lane that it turns into
                tight = _LEFT if quarter > 0 else _STOP
                bend = fillet((-tight, -aside), (out, -aside), (out, quarter * tight))
                way = polyline((-_END, -aside), bend, (out, quarter * _END))
            line = Line(quarter_turns(way, arm))
            stop = Gate(_END - _STOP, group, keeps_clear=line.length - _END + _STOP)
            gates = [stop]
            if turn == "left":  # waits in the middle until those who come straight on have passed
                gates.append(Gate(_END - 5.2))
            if turn != "straight":  # waits before the pedestrians who cross on its way out
                gates.append(Gate(line.length - _END + _WALK - 2.8))
            share = {"straight": 1.0, "left": 0.8, "right": 0.8}[turn]
            name = f"{turn}-{lane}-{arm}"
            rank = {"straight": 2, "right": 1, "left": 0}[turn]
            routes.append(Route(name, "vehicle", line, _SPEED, rank, tuple(gates), f"{lane}-{arm}", share))
    return routes


def _cycling(arm: int) -> list[Route]:
    group = "cycle-east-west" if arm % 2 == 0 else "cycle-north-south"
    stop = (Gate(_END - _STOP, group),)
    straight = Line(quarter_turns([(-_END, -_CYCLE), (_END, -_CYCLE)], arm))
    way = polyline(
        (-_END, -_CYCLE),
        fillet((-_HALF - _KERB, -_CYCLE), (-_CYCLE, -_CYCLE), (-_CYCLE, -_HALF - _KERB)),
        (-_CYCLE, -_END),
    )
    right = Line(quarter_turns(way, arm))
    lane = f"cycle-{arm}"
    return [
        Route(f"cycle-straight-{arm}", "cyclist", straight, _CYCLING, 2, stop, lane),
        Route(f"cycle-right-{arm}", "cyclist", right, _CYCLING, 1, stop, lane, 0.4),
    ]


def _walking(arm: int) -> list[Route]:
    """Return the ways along one side of a road: across the road that it meets, and around the corners."""
    group = "walk-east-west" if arm % 2 == 0 else "walk-north-south"
    kerb = Gate(_END - _HALF - 1.0, group)
    across = [(-_END, -_WALK), (_END, -_WALK)]
    around = polyline(
        (-_END, -_WALK), fillet((-_WALK - 3, -_WALK), (-_WALK, -_WALK), (-_WALK, -_WALK - 3)), (-_WALK, -_END)
    )
    routes = []
    for name, points, gates, share in (("cross", across, (kerb,), 1.0), ("corner", around, (), 0.3)):
        for way, ordered in (("on", points), ("back", points[::-1])):
            line = Line(quarter_turns(ordered, arm), smoothing=1.0)
            routes.append(
                Route(
                    f"{name}-{way}-{arm}",
                    "pedestrian",
                    line,
                    _WALKING,
                    3,
                    gates,
                    share=share,
                    spread=(-1.1, -0.4),
                )
            )
    return routes


def _parking() -> list[Route]:
    """Return the ways into the lay-by, which is on the right of the eastbound road, and out of it."""
    lane = Line([(-_END, -_OUTER), (_END, -_OUTER)])
    stop = Gate(_END - _STOP, "east-west", keeps_clear=_END + _STOP)
    routes = []
    for number, bay in enumerate(_BAYS):
        begin = _END + bay - 18.0
        into = Line([(bay - 30.0, -_BAY), (bay, -_BAY)], smoothing=0.0)
        way = polyline(lane.part(0.0, begin - 0.5), change_over(into, 12.0, _BAY - _OUTER, 16.0))
        out = polyline((bay, -_BAY), change_over(lane, _END + bay + 2.0, _OUTER - _BAY, 16.0))
        gates = (stop, Gate(begin + 2.5))
        routes += [
            Route(
                f"park-{number}",
                "vehicle",
                Line(way),
                _SPEED,
                0,
                gates,
                "outer-0",
                0.6,
                stops=True,
                then=f"leave-{number}",
            ),
            Route(f"leave-{number}", "vehicle", Line(out), _SPEED, -1, (Gate(4.0),), share=0.0),
        ]
    return routes
