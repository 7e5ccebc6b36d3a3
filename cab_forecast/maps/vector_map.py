"""A vector map: the polygons and lines of the contract's three layers."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

try:
    import shapely
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        'maps need shapely: pip install "cab-forecast[maps]"', name=error.name
    ) from error

from cab.forecast.v1.bounds import FIELD_BOUNDS
from cab.forecast.v1.prediction_service_pb2 import SceneRaster
from cab_forecast.layers import ImageEncoding, Layers
from cab_forecast.maps.rasterize import fill
from cab_forecast.rasters import raster_digest
from cab_forecast.requests import PIXELS_PER_METER, scene_raster

LAYERS: Final = ("driveable_area", "road_dividers", "lane_dividers")
"""Names of the layers, in the contract's order."""
DIVIDER_WIDTH = 2 / 3
"""Width of a drawn divider, m: two pixels of a patch, as in the maps that the networks were trained on."""
DEFAULT_SIZE = 300.0
"""Side of a cut, m: agents up to 75 m from its middle see all of their far patches (74 m)."""
MAX_PIXELS = 4096
"""Most rows and columns of a cut, by the servers' default limit."""

Shape = Any
"""A shapely geometry (shapely has no types), or an array of vertices [V, 2], m."""
_Floats = npt.NDArray[np.float64]
_DEGREES = (180.0, 90.0)
_NO_ROAD = 0.5
"""Extent of shapes, m, below which they are no road areas; in degrees nearly all are smaller."""
_NOT_FINITE = "{} of {} has a coordinate that is not finite"
_NO_TOWN = 10.0
"""Extent in degrees above which a map is no town."""


class MapError(ValueError):
    """A map that cannot be read or used; the text says why and what to do."""


class OffMapError(MapError):
    """A position that is off the map."""


@dataclass(frozen=True)
class Extent:
    """The bounding box of shapes, m."""

    low: _Floats
    """[2]"""
    high: _Floats
    """[2]"""

    def __str__(self) -> str:
        (x, y), (far_x, far_y) = self.low, self.high
        return f"x {x:.1f} … {far_x:.1f} m, y {y:.1f} … {far_y:.1f} m"


class VectorMap:
    """Polygons of the driveable area and lines of dividers, in metres in one ground frame."""

    def __init__(
        self, layers: Mapping[str, Iterable[Shape]], *, source: str = "the map", notes: Iterable[str] = ()
    ) -> None:
        """
        Args:
            layers: shapes by the name of their layer, see ``LAYERS``. ``driveable_area`` has polygons, the
                dividers have lines: shapely geometries, or arrays of vertices [V, 2], m, right-handed.
                Overlapping polygons are united.
            source: what errors call the map, e.g. its file.
            notes: what a user should know of how it was read.

        Raises:
            MapError: a layer's name is unknown, a shape is of another kind, a number is not finite, there is
                no driveable area, or the coordinates look like degrees.
        """
        unknown = [name for name in layers if name not in LAYERS]
        if unknown:
            raise MapError(f"{source} has no layer {unknown[0]!r}: layers are {', '.join(LAYERS)}")
        self.source = source
        self.notes = tuple(notes)
        self._shapes = [_shapes(name, layers.get(name, ()), source) for name in LAYERS]
        if not len(self._shapes[0]):
            raise MapError(
                f"{source} has no driveable area, without which models take every agent for off the road"
            )
        self.extent = _extent(self._shapes[0])
        _check_meters(self._shapes[0], self.extent, source)
        self._trees = [shapely.STRtree(shapes) for shapes in self._shapes]

    @property
    def counts(self) -> dict[str, int]:
        """The number of polygons or lines of each layer."""
        return {name: len(shapes) for name, shapes in zip(LAYERS, self._shapes, strict=True)}

    def anchor(self) -> tuple[float, float]:
        """Return the middle of the driveable polygon that is nearest to the middle of the map: x, y in m."""
        middle = shapely.Point((self.extent.low + self.extent.high) / 2)
        nearest = self._shapes[0][self._trees[0].nearest(middle)]
        point = nearest.representative_point()
        return float(point.x), float(point.y)

    def layers(
        self, origin: npt.ArrayLike, rows: int, columns: int, pixels_per_meter: float = PIXELS_PER_METER
    ) -> Layers:
        """Return the layers as pixels: [3, rows, columns], see ``cab_forecast.scene_raster``.

        Element [0, i, j] is true where the point ``origin + (i, j) / pixels_per_meter`` lies in the driveable
        area; in the other layers where it lies within half a divider's width of a divider.

        Args:
            origin: [2], m, the point that element [·, 0, 0] shows.
            rows: pixels along x.
            columns: pixels along y.
            pixels_per_meter: resolution.
        """
        corner = np.asarray(origin, dtype=np.float64)
        image: Layers = np.zeros((len(LAYERS), rows, columns), dtype=np.bool_)
        # Coarse pixels could fall on both sides of a narrower line, and leave gaps in it
        width = max(DIVIDER_WIDTH, np.sqrt(2) / pixels_per_meter)
        far = corner + np.array([rows, columns]) / pixels_per_meter
        window = shapely.box(*(corner - width), *(far + width))
        for layer, (shapes, tree) in enumerate(zip(self._shapes, self._trees, strict=True)):
            near = shapes[tree.query(window)]
            areas = near if layer == 0 else shapely.buffer(near, width / 2, cap_style="flat", quad_segs=4)
            for area in areas:
                fill(image[layer], _rings(area, corner, pixels_per_meter))
        return image

    def cut(
        self,
        center: npt.ArrayLike,
        size: float = DEFAULT_SIZE,
        pixels_per_meter: float = PIXELS_PER_METER,
        encoding: ImageEncoding = "packed_bits",
    ) -> SceneRaster:
        """Return the raster of a square around a position, with its digest.

        Args:
            center: [2], m.
            size: side of the square, m.
            pixels_per_meter: resolution.
            encoding: see ``cab_forecast.scene_raster``.

        Raises:
            OffMapError: no driveable area lies in the square.
            MapError: the square has no size, too many pixels, or a number is out of range.
        """
        middle = np.asarray(center, dtype=np.float64)
        pixels = _pixels(middle, size, pixels_per_meter)
        origin = middle - size / 2
        image = self.layers(origin, pixels, pixels, pixels_per_meter)
        if not image[0].any():
            x, y = middle
            raise OffMapError(
                f"no driveable area lies within {size / 2:g} m of ({x:.1f}, {y:.1f}): {self.source} has it "
                f"at {self.extent}"
            )
        raster = scene_raster(image, (float(origin[0]), float(origin[1])), pixels_per_meter, encoding)
        raster.digest = raster_digest(raster)
        return raster


def _shapes(layer: str, shapes: Iterable[Shape], source: str) -> npt.NDArray[np.object_]:
    """Return the simple shapes of a layer, without empty ones: polygons of the first, lines of the others."""
    kind = "Polygon" if layer == LAYERS[0] else "LineString"
    found = []
    for shape in shapes:
        geometry = shape if isinstance(shape, shapely.Geometry) else _from_vertices(layer, shape, source)
        for part in shapely.get_parts(geometry):
            if part.geom_type == "LinearRing":
                part = shapely.LineString(part)  # noqa: PLW2901
            if part.geom_type != kind:
                hint = " Give a line its width by line.buffer(width / 2)." if kind == "Polygon" else ""
                raise MapError(f"{layer} of {source} needs a {kind}, but holds a {part.geom_type}.{hint}")
            if part.is_empty:
                continue
            if not np.isfinite(shapely.get_coordinates(part)).all():
                raise MapError(_NOT_FINITE.format(layer, source))
            found.append(shapely.force_2d(part))
    return np.array(found, dtype=np.object_)


def _from_vertices(layer: str, vertices: npt.ArrayLike, source: str) -> Shape:
    points = np.asarray(vertices, dtype=np.float64)
    least = 3 if layer == LAYERS[0] else 2
    if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) < least:
        raise MapError(f"{layer} of {source} needs [V, 2] with V ≥ {least}, but has {list(points.shape)}")
    if not np.isfinite(points).all():  # shapely would warn
        raise MapError(_NOT_FINITE.format(layer, source))
    return shapely.Polygon(points[:, :2]) if layer == LAYERS[0] else shapely.LineString(points[:, :2])


def _extent(shapes: npt.NDArray[np.object_]) -> Extent:
    low_x, low_y, high_x, high_y = shapely.total_bounds(shapes)
    return Extent(np.array([low_x, low_y]), np.array([high_x, high_y]))


def _check_meters(areas: npt.NDArray[np.object_], extent: Extent, source: str) -> None:
    """Refuse areas whose coordinates are degrees by their sizes, or beyond the contract's bounds.

    Raises:
        MapError: they are.
    """
    reach = np.maximum(np.abs(extent.low), np.abs(extent.high))
    bounds = shapely.bounds(areas)
    sizes = np.hypot(bounds[:, 2] - bounds[:, 0], bounds[:, 3] - bounds[:, 1])
    if (
        (reach <= _DEGREES).all()
        and (extent.high - extent.low).max() < _NO_TOWN
        and np.median(sizes) < _NO_ROAD
    ):
        middle = (extent.low + extent.high) / 2
        raise MapError(
            f"the coordinates of {source} look like degrees (most areas are below {_NO_ROAD:g} m otherwise): "
            f"name the origin of your ground frame, e.g. origin=({middle[1]:.5f}, {middle[0]:.5f}), which is "
            "latitude and longitude (--origin on the command line)"
        )
    _, largest = FIELD_BOUNDS["SceneRaster.origin_x"]
    if reach.max() > largest:
        raise MapError(
            f"{source} reaches beyond ±{largest:g} m: {extent}. Shift it to an origin near the road."
        )


def _pixels(center: _Floats, size: float, pixels_per_meter: float) -> int:
    """Return the rows and columns of a cut."""
    lowest, highest = FIELD_BOUNDS["SceneRaster.pixels_per_meter"]
    if center.shape != (2,) or not np.isfinite(center).all():
        raise MapError(f"the middle of a cut must be x and y, but is {center.tolist()}")
    if not lowest <= pixels_per_meter <= highest:
        raise MapError(f"pixels per metre must be within {lowest:g} … {highest:g}, not {pixels_per_meter:g}")
    if not size > 0 or size * pixels_per_meter + 1 > MAX_PIXELS:
        raise MapError(
            f"the side of a cut must be above 0 and at most {(MAX_PIXELS - 1) / pixels_per_meter:g} m "
            f"({MAX_PIXELS} pixels), not {size:g} m"
        )
    return round(size * pixels_per_meter) + 1


def _rings(area: Shape, origin: _Floats, pixels_per_meter: float) -> list[_Floats]:
    """Return the rings of a polygon or multipolygon in pixels, each closed, [V, 2]."""
    return [
        (shapely.get_coordinates(ring) - origin) * pixels_per_meter
        for polygon in shapely.get_parts(area)
        for ring in shapely.get_rings(polygon)
    ]
