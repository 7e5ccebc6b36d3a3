"""OpenDRIVE (.xodr), versions 1.4 to 1.8.

No well-kept library on PyPI reads it (``docs/maps.md`` names those that were tried), so this module evaluates
roads itself: reference lines, lane offsets, widths or borders of lanes, and road marks. Heights, junction
boundaries and objects are not read.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import numpy.typing as npt
import shapely

from cab_forecast.maps.vector_map import MapError, Shape, VectorMap

_Floats = npt.NDArray[np.float64]
_Curve = Callable[[_Floats], tuple[_Floats, _Floats]]
"""Positions [N, 2] and headings [N] in a geometry's own frame, at distances [N] from its start."""

_STEP = 0.5
"""Most metres between two points along a road. In a curve of 10 m radius the chord is 3 mm off the arc."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
"""Gauss-Legendre quadrature on (−1, 1)."""
_TRAFFIC: Final = frozenset(
    {
        "driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane", "bidirectional",
        "bus", "taxi", "HOV", "mwyEntry", "mwyExit",
    }
)  # fmt: skip
"""Types of lanes that vehicles drive on."""
_DRIVEABLE: Final = _TRAFFIC | {"shoulder", "stop"}
"""Types of lanes that belong to the driveable area."""


def read(file: Path) -> VectorMap:
    """Read an OpenDRIVE map, in metres of its own frame.

    The driveable area is that of its lanes for vehicles and of its shoulders, also in junctions. The
    marked line between two lanes for vehicles is a divider: of roads at the road's centre, else of lanes.

    Raises:
        OSError: the file cannot be read.
        MapError: it is no OpenDRIVE map, or has no driveable area.
    """
    try:
        root = ElementTree.parse(file).getroot()  # noqa: S314 - expat bounds the expansion of entities
    except ElementTree.ParseError as error:
        raise MapError(f"{file.name} is no map of OpenDRIVE: {error}") from error
    if root.tag.rpartition("}")[2] != "OpenDRIVE":
        raise MapError(f"{file.name} is no map of OpenDRIVE: its root is {root.tag}")
    shapes: dict[str, list[Shape]] = {"driveable_area": [], "road_dividers": [], "lane_dividers": []}
    for road in root.iterfind("{*}road"):
        try:
            for section in _sections(road):
                shapes["driveable_area"] += section.areas()
                shapes["road_dividers"] += section.center_lines()
                shapes["lane_dividers"] += section.lane_lines()
        except (KeyError, ValueError) as error:
            raise MapError(f"road {road.get('id')} of {file.name} is malformed: {error!r}") from error
    return VectorMap(shapes, source=file.name)


@dataclass(frozen=True)
class _Lane:
    """One lane of a section, with its borders as points along the road."""

    element: Element
    inner: _Floats
    """[N, 2], m, nearer to the road's centre."""
    outer: _Floats
    """[N, 2], m"""

    @property
    def kind(self) -> str:
        return self.element.get("type", "none")


@dataclass(frozen=True)
class _Section:
    """A lane section: the stretch of a road with one set of lanes."""

    along: _Floats
    """[N], m from the section's start."""
    left: Sequence[_Lane]
    """From the centre outwards."""
    right: Sequence[_Lane]
    center: Element | None

    def areas(self) -> list[Shape]:
        """Return the polygons of the driveable lanes."""
        lanes = [lane for lane in (*self.left, *self.right) if lane.kind in _DRIVEABLE]
        return [shapely.Polygon(np.concatenate([lane.inner, lane.outer[::-1]])) for lane in lanes]

    def lane_lines(self) -> list[Shape]:
        """Return the marked lines between two lanes of one side."""
        return [
            line
            for side in (self.left, self.right)
            for lane, outer in pairwise(side)
            if {lane.kind, outer.kind} <= _TRAFFIC
            for line in self._marked(lane.element, lane.outer)
        ]

    def center_lines(self) -> list[Shape]:
        """Return the marked lines between the innermost lanes of the two sides."""
        if self.center is None or not self.left or not self.right:
            return []
        if not {self.left[0].kind, self.right[0].kind} <= _TRAFFIC:
            return []
        return list(self._marked(self.center, self.left[0].inner))

    def _marked(self, lane: Element, border: _Floats) -> Iterator[Shape]:
        """Yield the parts of a lane's outer border that are marked."""
        marks = sorted(lane.iterfind("{*}roadMark"), key=_offset)
        ends = [*map(_offset, marks[1:]), np.inf]
        for mark, end in zip(marks, ends, strict=False):
            part = border[(self.along >= _offset(mark) - 1e-9) & (self.along <= end + 1e-9)]
            if mark.get("type", "none") != "none" and len(part) > 1:
                yield shapely.LineString(part)


def _sections(road: Element) -> Iterator[_Section]:
    """Yield the lane sections of a road that have a length."""
    length = float(road.attrib["length"])
    lanes = road.find("{*}lanes")
    elements = [] if lanes is None else sorted(lanes.iterfind("{*}laneSection"), key=_start)
    geometries = sorted(road.iterfind("{*}planView/{*}geometry"), key=_start)
    if not geometries or lanes is None:
        return
    offsets = list(lanes.iterfind("{*}laneOffset"))
    for element, end in zip(elements, [*map(_start, elements[1:]), length], strict=True):
        start = _start(element)
        breaks = [_start(one) for one in (*geometries, *offsets)]
        breaks += [start + _offset(one) for one in element.iter() if "sOffset" in one.attrib]
        stations = _stations(start, end, breaks)
        if len(stations) > 1:
            yield _section(
                element, stations, _reference(geometries, stations), _cubic(offsets, stations, "s")
            )


def _section(
    element: Element, stations: _Floats, reference: tuple[_Floats, _Floats], offset: _Floats
) -> _Section:
    points, headings = reference
    normals = np.stack([-np.sin(headings), np.cos(headings)], axis=1)
    along = stations - _start(element)

    def side(name: str, sign: float) -> list[_Lane]:
        lanes, inner = [], offset
        for lane in sorted(
            element.iterfind(f"{{*}}{name}/{{*}}lane"), key=lambda one: abs(int(one.attrib["id"]))
        ):
            widths, borders = list(lane.iterfind("{*}width")), list(lane.iterfind("{*}border"))
            if borders and not widths:
                outer = offset + _cubic(borders, along, "sOffset")
            else:
                outer = inner + sign * _cubic(widths, along, "sOffset")
            lanes.append(_Lane(lane, points + inner[:, None] * normals, points + outer[:, None] * normals))
            inner = outer
        return lanes

    return _Section(along, side("left", 1.0), side("right", -1.0), element.find("{*}center/{*}lane"))


def _start(element: Element) -> float:
    return float(element.attrib["s"])


def _offset(element: Element) -> float:
    return float(element.get("sOffset", 0.0))


def _stations(start: float, end: float, breaks: Sequence[float]) -> _Floats:
    """Return ascending distances from the road's start: both ends, the breaks between them, and steps."""
    steps = np.linspace(start, end, max(2, int(np.ceil((end - start) / _STEP)) + 1))
    inside = [one for one in breaks if start < one < end]
    return np.unique(np.concatenate([steps, inside])) if end > start else np.empty(0)


def _cubic(records: Sequence[Element], at: _Floats, key: str) -> _Floats:
    """Return piecewise cubics a + b·d + c·d² + d·d³ at distances, d from a record's start; 0 before all."""
    values = np.zeros_like(at)
    for record in sorted(records, key=lambda one: float(one.attrib[key])):
        begin = float(record.attrib[key])
        a, b, c, d = (float(record.get(name, 0.0)) for name in "abcd")
        x = at - begin
        values = np.where(x >= -1e-9, a + x * (b + x * (c + x * d)), values)
    return values


def _reference(geometries: Sequence[Element], stations: _Floats) -> tuple[_Floats, _Floats]:
    """Return positions [N, 2] and headings [N] of a road's reference line."""
    points, headings = np.empty((len(stations), 2)), np.empty(len(stations))
    starts = np.array([_start(one) for one in geometries])
    owner = np.maximum(np.searchsorted(starts, stations + 1e-9, side="right") - 1, 0)
    for index in np.unique(owner):
        element, mine = geometries[index], owner == index
        local, turned = _curve(element)(stations[mine] - starts[index])
        x, y, heading = (float(element.attrib[name]) for name in ("x", "y", "hdg"))
        cos, sin = np.cos(heading), np.sin(heading)
        points[mine] = local @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
        headings[mine] = turned + heading
    return points, headings


def _curve(geometry: Element) -> _Curve:
    """Return the curve of a geometry.

    Raises:
        ValueError: its kind is unknown.
    """
    length = float(geometry.attrib["length"])
    for kind in geometry:
        number = {name: float(value) for name, value in kind.attrib.items() if name != "pRange"}
        match kind.tag.rpartition("}")[2]:
            case "line":
                return _clothoid(0.0, 0.0, length)
            case "arc":
                return _clothoid(number["curvature"], number["curvature"], length)
            case "spiral":
                return _clothoid(number["curvStart"], number["curvEnd"], length)
            case "poly3":
                v = np.array([number[name] for name in "abcd"])
                return _polynomial(np.array([0.0, 1.0, 0.0, 0.0]), v, partial(_at_arc_length, v, length))
            case "paramPoly3":
                u, v = (np.array([number[name + axis] for name in "abcd"]) for axis in "UV")
                scale = 1.0 if kind.get("pRange") == "arcLength" else 1 / length
                return _polynomial(u, v, partial(np.multiply, scale))
    raise ValueError("a geometry is neither line, arc, spiral, poly3 nor paramPoly3")


def _clothoid(start: float, end: float, length: float) -> _Curve:
    """Return a curve whose curvature, 1/m, changes linearly; lines and arcs are such curves."""
    rate = (end - start) / length

    def curve(at: _Floats) -> tuple[_Floats, _Floats]:
        begin = np.concatenate([[0.0], at[:-1]])
        half = (at - begin) / 2
        s = begin[:, None] + half[:, None] * (1 + _NODES)
        heading = s * (start + s * rate / 2)
        steps = np.stack([np.cos(heading) @ _WEIGHTS, np.sin(heading) @ _WEIGHTS], axis=1) * half[:, None]
        return np.cumsum(steps, axis=0), at * (start + at * rate / 2)

    return curve


def _polynomial(u: _Floats, v: _Floats, parameter: Callable[[_Floats], _Floats]) -> _Curve:
    """Return the curve (u(p), v(p)) of two cubics [4], ascending powers, with p of the distance."""

    def curve(at: _Floats) -> tuple[_Floats, _Floats]:
        p = parameter(at)
        one = np.ones_like(p)
        value = np.stack([one, p, p**2, p**3])
        slope = np.stack([0 * one, one, 2 * p, 3 * p**2])
        return np.stack([u @ value, v @ value], axis=1), np.arctan2(v @ slope, u @ slope)

    return curve


def _at_arc_length(v: _Floats, length: float, at: _Floats) -> _Floats:
    """Return the u at which the curve (u, v(u)) has the lengths [N]."""
    u = np.linspace(0.0, length, max(2, int(length / 0.05)))
    steps = np.hypot(np.diff(u), np.diff(np.polynomial.polynomial.polyval(u, v)))
    return np.interp(at, np.concatenate([[0.0], np.cumsum(steps)]), u)
