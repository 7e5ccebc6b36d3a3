"""Scene rasters from vector maps: nuScenes, Argoverse 2, Lanelet2, OpenDRIVE, GeoJSON, or shapes.

``read_map`` reads a file to a ``VectorMap``; ``MapCutter`` cuts rasters around positions, the same one as
long as a vehicle stays near. The package needs ``pip install "cab-forecast[maps]"``.
"""

from cab_forecast.maps.cutter import MapCutter
from cab_forecast.maps.files import FORMATS, read_map
from cab_forecast.maps.vector_map import LAYERS, MapError, OffMapError, VectorMap

__all__ = ["FORMATS", "LAYERS", "MapCutter", "MapError", "OffMapError", "VectorMap", "read_map"]
