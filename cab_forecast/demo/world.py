"""Description of a place where traffic is simulated: its routes, its lights and who drives on which route."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from typing import Literal

import numpy as np

from cab.forecast.v1.prediction_service_pb2 import SceneRaster
from cab_forecast.demo.lines import STEP, Floats, Line, Lines

Kind = Literal["vehicle", "cyclist", "pedestrian"]


@dataclass(frozen=True)
class Body:
    """Outline of a kind of road user: a rectangle, covered by discs in a row."""

    length: float
    """m."""
    width: float
    """m."""
    discs: tuple[float, ...]
    """Centres of the discs, m ahead of the middle."""
    radius: float
    """Radius of the discs, m."""


BODIES: Mapping[Kind, Body] = {
    "vehicle": Body(4.6, 1.9, (-1.8, -0.9, 0.0, 0.9, 1.8), 1.07),
    "cyclist": Body(1.8, 0.7, (-0.5, 0.0, 0.5), 0.5),
    "pedestrian": Body(0.6, 0.6, (0.0,), 0.3),
}
_MARGIN = 0.3
"""Free space between bodies that pass each other where ways cross, m."""
_STRIDE = 2
"""Points of lines from one that is compared to the next."""
_MERGING = 6.0
"""Length of the first part of a common way, m: who has right of way there is settled; then one follows."""


class Light(Enum):
    """Colour of a traffic light."""

    GREEN = "green"
    YELLOW = "yellow"
    RED = "red"


@dataclass(frozen=True)
class Signals:
    """Traffic lights that repeat a cycle."""

    cycle: float = 1.0
    """s."""
    green: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Start and end of the green light of each group, s from the beginning of the cycle."""
    yellow: Mapping[str, float] = field(default_factory=dict)
    """Duration of the yellow light after the green one, s; groups without one have none."""

    def light(self, group: str, time: float) -> Light:
        """Return the colour of a group's light at a time, s."""
        start, end = self.green[group]
        since = (time - start) % self.cycle
        if since < end - start:
            return Light.GREEN
        return Light.YELLOW if since < end - start + self.yellow.get(group, 0.0) else Light.RED


@dataclass(frozen=True)
class Gate:
    """A place on a route where its users wait until their way is free."""

    place: float
    """Distance along the route at which the front of a body stops, m."""
    group: str | None = None
    """Its traffic light."""
    keeps_clear: float = 0.0
    """Distance along the route, m, up to which nobody may have to stop behind the gate: a junction's end."""


@dataclass(frozen=True)
class Route:
    """A way through the scene."""

    name: str
    kind: Kind
    line: Line
    speed: float
    """Desired speed of a typical user on a straight part, m/s."""
    rank: int = 0
    """Where ways cross, the one of the higher rank goes first."""
    gates: tuple[Gate, ...] = ()
    """In order of their places."""
    origin: str = ""
    """Lane on which it begins: users of routes of the same lane follow each other."""
    share: float = 1.0
    """How often it is taken, relative to the other routes of its kind; 0: only after another one."""
    stops: bool = False
    """True if one stops at its end: to park, or because the lane ends."""
    then: str = ""
    """Route that one takes after having parked; empty: one leaves the scene."""
    spread: tuple[float, float] = (0.0, 0.0)
    """Limits of a user's own distance to the left of the line, m."""


@dataclass(frozen=True)
class Zone:
    """Part of a route that another one crosses or joins."""

    foe: str
    """Name of the other route."""
    start: float
    """Distance along the own route, m."""
    end: float
    foe_start: float
    """Distance along the other route, m."""
    foe_end: float
    foe_gate: int
    """Number of the other route's gate before the zone; -1: none."""
    yields: bool
    """True if the other route goes first."""
    merges: bool
    """True if the ways go on together."""


@dataclass(frozen=True)
class Lanes:
    """Parallel lanes between which vehicles change."""

    routes: tuple[str, ...]
    """Names of their routes, from right to left."""
    ending: str
    """The one that ends, which all have to leave; empty: none."""
    start: float
    """Distance along the lanes from which on vehicles change, m."""
    end: float
    """Distance along the lanes up to which they do, m."""


@dataclass(frozen=True)
class World:
    """A place where traffic is simulated."""

    name: str
    raster: SceneRaster
    routes: Mapping[str, Route]
    population: Mapping[Kind, int]
    """Usual numbers of road users."""
    signals: Signals = field(default_factory=Signals)
    lanes: tuple[Lanes, ...] = ()

    @cached_property
    def lines(self) -> Lines:
        """Lines of the routes, in their order."""
        return Lines([route.line for route in self.routes.values()])

    @cached_property
    def number(self) -> Mapping[str, int]:
        """Numbers of the routes' lines, by their names."""
        return {name: number for number, name in enumerate(self.routes)}

    @cached_property
    def zones(self) -> Mapping[str, Sequence[Sequence[Zone]]]:
        """Zones by route and by the number of the gate before them."""
        found: dict[str, list[list[Zone]]] = {
            name: [[] for _ in one.gates] for name, one in self.routes.items()
        }
        for name, one in self.routes.items():
            for other in self.routes.values():
                zone = None if one is other else _zone(one, other)
                if zone is not None and (gate := _gate_before(one, zone.start)) >= 0:
                    found[name][gate].append(zone)
        return found


def _zone(one: Route, other: Route) -> Zone | None:
    """Return where a route meets another one after its first gate; None: nowhere."""
    walkers = one.kind == other.kind == "pedestrian"  # they walk around each other
    if walkers or not one.gates or (one.origin and one.origin == other.origin):
        return None
    (ours, first), (theirs, foe_first) = _beyond_gate(one), _beyond_gate(other)
    reach = (BODIES[one.kind].width + BODIES[other.kind].width) / 2 + _MARGIN
    reach += sum(max(map(abs, route.spread)) for route in (one, other))  # their own ways are beside the lines
    if (ours.min(axis=0) > theirs.max(axis=0) + reach).any() or (
        theirs.min(axis=0) > ours.max(axis=0) + reach
    ).any():
        return None
    near = ((ours[:, None] - theirs[None]) ** 2).sum(axis=-1) < reach**2
    if not near.any():
        return None
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    start, end = (first + row * _STRIDE * STEP for row in rows[[0, -1]].tolist())
    foe_start, foe_end = (foe_first + column * _STRIDE * STEP for column in columns[[0, -1]].tolist())
    merges = end - start > _MERGING and foe_end - foe_start > _MERGING
    if merges:
        end, foe_end = start + _MERGING, foe_start + _MERGING
    gate = _gate_before(other, foe_start)
    return Zone(other.name, start, end, foe_start, foe_end, gate, other.rank > one.rank, merges)


def _beyond_gate(route: Route) -> tuple[Floats, float]:
    """Return points of a route behind its first gate, if it has any, and the distance of the first, m."""
    first = round(route.gates[0].place / STEP) if route.gates else 0
    return route.line.points[first::_STRIDE], first * STEP


def _gate_before(route: Route, place: float) -> int:
    """Return the number of the last gate before a place along a route beyond its first one; -1: no gates."""
    return max(sum(gate.place <= place for gate in route.gates), min(len(route.gates), 1)) - 1
