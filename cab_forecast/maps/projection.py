"""Projection of degrees to metres."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from cab_forecast.maps.vector_map import MapError

Origin = tuple[float, float]
"""Latitude and longitude, degrees."""
_FARTHEST = 4.5
"""Degrees of longitude from a UTM zone's middle up to which it is used."""


def check_origin(origin: Origin) -> None:
    """Refuse an origin that is no latitude and longitude.

    Raises:
        MapError: it is none.
    """
    latitude, longitude = origin
    if not (-80 <= latitude <= 84 and -180 <= longitude < 180):
        raise MapError(
            f"an origin is latitude (−80 … 84) and longitude (−180 … 180) in degrees, not "
            f"{latitude:g}, {longitude:g}"
        )


class UtmProjection:
    """Longitude and latitude (WGS 84) to x (east) and y (north) from an origin, in the origin's UTM zone.

    It is the frame of Lanelet2's ``UtmProjector(Origin(latitude, longitude))``, but for the widened zones of
    Norway and Svalbard.
    """

    def __init__(self, origin: Origin) -> None:
        """
        Raises:
            MapError: the origin is no latitude and longitude.
            ModuleNotFoundError: pyproj is not installed.
        """
        try:
            from pyproj import Transformer  # noqa: PLC0415 - only maps in degrees need it
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                'maps in degrees need pyproj: pip install "cab-forecast[maps]"', name=error.name
            ) from error
        check_origin(origin)
        latitude, longitude = origin
        zone = math.floor((longitude + 180) / 6) + 1
        self._middle = zone * 6 - 183
        utm = f"EPSG:{(32600 if latitude >= 0 else 32700) + zone}"
        self._transformer: Any = Transformer.from_crs("OGC:CRS84", utm, always_xy=True)
        self._offset: npt.NDArray[np.float64] = np.array(self._transformer.transform(longitude, latitude))

    def __call__(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the ground positions of points: [N, 2], m.

        Args:
            points: [N, 2], longitude and latitude, degrees.

        Raises:
            MapError: a point is no longitude and latitude, or too far from the origin's zone.
        """
        away = (points[:, 0] - self._middle + 180) % 360 - 180
        if not (np.abs(points) <= (180, 90)).all():
            raise MapError(
                "the map has an origin in degrees, but coordinates that are no longitude and latitude: "
                "if they are metres, leave the origin out"
            )
        if np.abs(away).max() > _FARTHEST:
            raise MapError("the map is too far from its origin: the origin is latitude, then longitude")
        ground: npt.NDArray[np.float64] = np.stack(
            self._transformer.transform(points[:, 0], points[:, 1]), axis=1
        )
        return ground - self._offset
