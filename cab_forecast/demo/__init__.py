"""Synthetic demo scene: traffic at a crossing of two roads.

The scene is computed and deterministic; there is no data to load or to license.
"""

from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab_forecast.demo.crossing import crossing_raster
from cab_forecast.demo.traffic import NOW, traffic
from cab_forecast.requests import predict_request

__all__ = ["demo_request"]


def demo_request(time: float = NOW) -> PredictRequest:
    """Build a request with eleven agents at a four-way crossing, and its map.

    Args:
        time: the present, seconds since the epoch, at which the histories end.
    """
    return predict_request(time, traffic(time), scene_id="demo", raster=crossing_raster())
