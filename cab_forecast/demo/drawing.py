"""Drawing of roads into the map of a scene."""

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from cab.forecast.v1.prediction_service_pb2 import SceneRaster
from cab_forecast.demo.lines import Floats, Line
from cab_forecast.layers import Layers
from cab_forecast.requests import PIXELS_PER_METER, scene_raster

DRIVEABLE, ROAD_DIVIDER, LANE_DIVIDER = range(3)
_DIVIDER_PIXELS = 2


class Painter:
    """Painter of a map."""

    def __init__(self, low: tuple[float, float], high: tuple[float, float]) -> None:
        """
        Args:
            low: ground position of the first pixel, m.
            high: ground position of the last pixel, m.
        """
        self._origin = low
        rows, columns = (
            round((end - start) * PIXELS_PER_METER) + 1 for start, end in zip(low, high, strict=True)
        )
        self._images = [Image.new("1", (columns, rows)) for _ in range(3)]
        self._draws = [ImageDraw.Draw(image) for image in self._images]

    def layers(self) -> Layers:
        """Return the layers as drawn so far: [3, rows, columns]."""
        return np.stack([np.asarray(image) for image in self._images])

    def raster(self) -> SceneRaster:
        """Return the map as drawn so far."""
        return scene_raster(self.layers(), self._origin)

    def area(self, points: npt.ArrayLike, driveable: bool = True) -> None:
        """Fill a polygon [V, 2], m."""
        self._draws[DRIVEABLE].polygon(self._pixels(points), fill=int(driveable))

    def ribbon(self, line: Line, right: float, left: float) -> None:
        """Fill the area along a line, between distances to its left, m; negative: to its right."""
        for start in range(0, len(line.points) - 1, 20):  # the outline of a whole line could cross itself
            piece = slice(start, start + 22)
            self.area(np.concatenate([line.beside(right)[piece], line.beside(left)[piece][::-1]]))

    def stroke(self, layer: int, points: npt.ArrayLike) -> None:
        """Draw a divider along points [V, 2], m."""
        self._draws[layer].line(self._pixels(points), fill=1, width=_DIVIDER_PIXELS)

    def _pixels(self, points: npt.ArrayLike) -> list[tuple[float, float]]:
        # Rows of the map run along x, lines of the image along y: a pixel (column, row) is (y, x)
        pixels: Floats = (np.asarray(points, dtype=np.float64) - self._origin) * PIXELS_PER_METER
        return [(y, x) for x, y in pixels.tolist()]
