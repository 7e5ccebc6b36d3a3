"""A made-up scene to try a server with: traffic at a crossing of two roads.

Everything is computed here, the same at every call; there is no data to load and none to license.
"""

from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab_forecast.demo.crossing import crossing_raster
from cab_forecast.demo.traffic import NOW, traffic
from cab_forecast.requests import predict_request

__all__ = ["demo_request"]


def demo_request(time: float = NOW) -> PredictRequest:
    """A request with eleven agents at a four-way crossing, and its map.

    Args:
        time: the present, s since the epoch; the histories end there.
    """
    return predict_request(time, traffic(time), scene_id="demo", raster=crossing_raster())
