"""Cuts of a map around positions, kept so that a driving stack sends each only once."""

import threading
from collections import OrderedDict

import numpy as np

from cab.forecast.v1.prediction_service_pb2 import SceneRaster
from cab_forecast.layers import ImageEncoding
from cab_forecast.maps.vector_map import DEFAULT_SIZE, MapError, VectorMap
from cab_forecast.requests import PIXELS_PER_METER

DEFAULT_STEP = 50.0
_KEPT = 16
"""Cuts that are kept, the most recently used ones."""


class MapCutter:
    """Rasters of a map around positions, usable from several threads.

    The middles of the cuts lie on a grid, so all positions of one cell of the grid get the same raster, byte
    for byte. Clients send a raster once and name it by its digest from then on.
    """

    def __init__(
        self,
        vector_map: VectorMap,
        *,
        size: float = DEFAULT_SIZE,
        step: float = DEFAULT_STEP,
        pixels_per_meter: float = PIXELS_PER_METER,
        encoding: ImageEncoding = "packed_bits",
    ) -> None:
        """
        Args:
            vector_map: the map.
            size: side of a cut, m; it reaches at least (size − step) / 2 beyond the position.
            step: width of the grid's cells, m.
            pixels_per_meter: resolution.
            encoding: see ``cab_forecast.scene_raster``.

        Raises:
            MapError: the step is not above 0, or not below the size.
        """
        if not 0 < step < size:
            raise MapError(f"the step must be above 0 and below the size of {size:g} m, not {step:g} m")
        self.vector_map = vector_map
        self._size, self._step, self._encoding = size, step, encoding
        self._pixels_per_meter = pixels_per_meter
        self._cuts: OrderedDict[tuple[int, int], SceneRaster] = OrderedDict()
        self._lock = threading.Lock()

    def around(self, x: float, y: float) -> SceneRaster:
        """Return the raster around a position, m, which must not be changed: later calls return it, too.

        Raises:
            OffMapError: no driveable area lies in the cut.
            MapError: the position is not finite, or the cut has too many pixels.
        """
        if not np.isfinite((x, y)).all():
            raise MapError(f"a position must be finite, not ({x}, {y})")
        cell = (round(x / self._step), round(y / self._step))
        with self._lock:
            if cell not in self._cuts:
                center = (cell[0] * self._step, cell[1] * self._step)
                self._cuts[cell] = self.vector_map.cut(
                    center, self._size, self._pixels_per_meter, self._encoding
                )
                if len(self._cuts) > _KEPT:
                    self._cuts.popitem(last=False)
            self._cuts.move_to_end(cell)
            return self._cuts[cell]
