"""Lanelet2 maps (.osm), read by the library ``lanelet2``."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from cab_forecast.maps.projection import Origin, check_origin
from cab_forecast.maps.vector_map import MapError, VectorMap

_LOCAL = ("local_x", "local_y")
"""Tags of points in metres, which the maps of Autoware have."""


def read(file: Path, origin: Origin | None) -> VectorMap:
    """Read a Lanelet2 map.

    The driveable area is that of all lanelets and areas that vehicles may pass. A line between two of these
    lanelets is a divider unless it is virtual: of lanes if both go the same way, else of roads.

    Args:
        file: the file.
        origin: latitude and longitude of the ground frame's origin; None: the points have the tags
            ``local_x`` and ``local_y``.

    Raises:
        OSError: the file cannot be read.
        MapError: it is no such map, or has neither these tags nor an origin.
        ModuleNotFoundError: lanelet2 is not installed.
    """
    try:
        import lanelet2  # noqa: PLC0415 - for Linux only
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'maps of Lanelet2 need the library lanelet2 (Linux, x86-64): pip install "cab-forecast[maps]"',
            name=error.name,
        ) from error
    with file.open("rb"):
        pass  # lanelet2 does not tell a missing file from a broken one
    if origin is None:
        # Its coordinates are not used, but it projects any map and back
        projector: Any = lanelet2.projection.MercatorProjector(lanelet2.io.Origin(0.0, 0.0))
    else:
        check_origin(origin)
        projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(*origin))
    try:
        lanelet_map, faults = lanelet2.io.loadRobust(str(file), projector)
    except RuntimeError as error:
        raise MapError(f"{file.name} is no map of Lanelet2: {error}") from error
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    lanelets = [lanelet for lanelet in lanelet_map.laneletLayer if rules.canPass(lanelet)]
    areas = [area for area in lanelet_map.areaLayer if rules.canPass(area)]
    points = _Points(file, projector, local=origin is None)
    roads, lanes = _dividers(lanelets)
    return VectorMap(
        {
            "driveable_area": [*map(points.lanelet, lanelets), *map(points.area, areas)],
            "road_dividers": [shapely.LineString(points.of(line)) for line in roads],
            "lane_dividers": [shapely.LineString(points.of(line)) for line in lanes],
        },
        source=file.name,
        notes=[f"lanelet2: {fault}" for fault in faults],
    )


class _Points:
    """Ground positions of a map's points: [V, 2], m."""

    def __init__(self, file: Path, projector: Any, *, local: bool) -> None:
        self._file, self._projector, self._local = file, projector, local

    def of(self, points: Iterable[Any]) -> npt.NDArray[np.float64]:
        return np.array([self._position(point) for point in points], dtype=np.float64)

    def lanelet(self, lanelet: Any) -> Any:
        outline = np.concatenate([self.of(lanelet.leftBound), self.of(lanelet.rightBound)[::-1]])
        return shapely.Polygon(outline)

    def area(self, area: Any) -> Any:
        return shapely.Polygon(
            self.of(area.outerBoundPolygon), [self.of(hole) for hole in area.innerBoundPolygons]
        )

    def _position(self, point: Any) -> tuple[float, float]:
        if not self._local:
            return point.x, point.y
        try:
            return float(point.attributes[_LOCAL[0]]), float(point.attributes[_LOCAL[1]])
        except KeyError as error:
            place = self._projector.reverse(point.basicPoint())
            raise MapError(
                f"{self._file.name} is in degrees, and its points lack the tags {' and '.join(_LOCAL)}: name "
                f"the origin of your ground frame, e.g. origin=({place.lat:.5f}, {place.lon:.5f}), which is "
                "latitude and longitude (--origin on the command line)"
            ) from error


def _dividers(lanelets: Iterable[Any]) -> tuple[list[Any], list[Any]]:
    """Return the lines between lanelets of opposite directions, and those between lanelets of the same."""
    sides: dict[int, list[tuple[Any, bool]]] = defaultdict(list)
    for lanelet in lanelets:
        for line, is_left in _bounds(lanelet):
            sides[line.id].append((line, is_left))
    roads: list[Any] = []
    lanes: list[Any] = []
    for uses in sides.values():
        (line, first), *others = uses
        if not others or _type(line) == "virtual":
            continue
        # The left bound of two lanelets separates opposite directions
        (roads if all(is_left == first for _, is_left in others) else lanes).append(line)
    return roads, lanes


def _bounds(lanelet: Any) -> Iterator[tuple[Any, bool]]:
    yield lanelet.leftBound, True
    yield lanelet.rightBound, False


def _type(line: Any) -> str:
    return str(line.attributes["type"]) if "type" in line.attributes else ""
