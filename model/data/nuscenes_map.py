"""Rasters from nuScenes' vector maps.

The devkit's own ``get_map_mask`` is not used: it clips every polygon of the map again for each patch, and
fails (with Shapely 2) on dividers that the patch cuts into pieces. Pixels are chosen as in the devkit:
vertices of areas are rounded, those of dividers truncated, dividers are two pixels wide.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import Bytes, Floats
from model.scenes.scene import Raster

PIXELS_PER_METER = 3.0
_DIVIDER_PIXELS = 2


@dataclass(frozen=True)
class _Shape:
    """The rings of a polygon (the outer one and its holes), or one line."""

    rings: Sequence[Floats]
    """Each [V, 2], m."""
    low: Floats
    """[2], m, corner of the bounding box."""
    high: Floats


class VectorMap:
    """Driveable area and dividers of one location."""

    def __init__(self, devkit_map: Any) -> None:
        """
        Args:
            devkit_map: a ``nuscenes.map_expansion.map_api.NuScenesMap``.
        """
        areas = [
            record["polygon_token"]
            for name in ("lane", "road_segment")
            for record in getattr(devkit_map, name)
        ]
        areas += [token for record in devkit_map.drivable_area for token in record["polygon_tokens"]]
        self._areas = [_area(devkit_map.extract_polygon(token)) for token in areas]
        self._dividers = [_lines(devkit_map, name) for name in ("road_divider", "lane_divider")]
        self._cv2 = import_module("cv2")

    def raster(self, low: Floats, high: Floats) -> Raster:
        """Return the map between two corners, at 3 pixels per metre.

        Args:
            low: [2], m; the raster's origin is the whole metre at or before it.
            high: [2], m, inside the raster.
        """
        origin = np.floor(low)
        rows, columns = np.ceil((high - origin) * PIXELS_PER_METER).astype(int) + 1
        layers = np.zeros((3, rows, columns), dtype=np.uint8)
        far = origin + np.array([rows, columns]) / PIXELS_PER_METER
        self._fill(layers[0], origin, far)
        for layer, dividers in zip(layers[1:], self._dividers, strict=True):
            self._draw(layer, dividers, origin, far)
        return Raster(layers, origin, PIXELS_PER_METER)

    def _fill(self, layer: Bytes, origin: Floats, far: Floats) -> None:
        for shape in _within(self._areas, origin, far):
            pixels = [np.round((ring - origin) * PIXELS_PER_METER) for ring in shape.rings]
            # All rings in one call, so that holes are not filled
            self._cv2.fillPoly(layer, [_cv2_points(ring) for ring in pixels], 1)

    def _draw(self, layer: Bytes, dividers: Sequence[_Shape], origin: Floats, far: Floats) -> None:
        for shape in _within(dividers, origin, far):
            pixels = [np.floor((line - origin) * PIXELS_PER_METER) for line in shape.rings]
            self._cv2.polylines(layer, [_cv2_points(line) for line in pixels], False, 1, _DIVIDER_PIXELS)


def _area(polygon: Any) -> _Shape:
    """Return the shape of a shapely polygon."""
    return _shape([_vertices(polygon.exterior), *(_vertices(hole) for hole in polygon.interiors)])


def _lines(devkit_map: Any, name: str) -> list[_Shape]:
    lines = (devkit_map.extract_line(record["line_token"]) for record in getattr(devkit_map, name))
    return [_shape([_vertices(line)]) for line in lines if not line.is_empty]


def _vertices(geometry: Any) -> Floats:
    return np.asarray(geometry.coords, dtype=np.float64)[:, :2]


def _shape(rings: Sequence[Floats]) -> _Shape:
    return _Shape(rings, rings[0].min(axis=0), rings[0].max(axis=0))


def _within(shapes: Sequence[_Shape], low: Floats, high: Floats) -> Iterator[_Shape]:
    """Return the shapes whose bounding boxes intersect the box."""
    return (shape for shape in shapes if (shape.low <= high).all() and (shape.high >= low).all())


def _cv2_points(pixels: Floats) -> NDArray[np.int32]:
    """Return points in cv2's order, (column, row): the raster's lines run along x, so that is (y, x)."""
    return np.ascontiguousarray(pixels[:, ::-1]).astype(np.int32)
