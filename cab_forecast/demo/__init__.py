"""Traffic for demos: simulated scenes that move, and one moment of them as a request.

The scenes are computed and deterministic; there is no data to load or to license.
"""

from functools import cache

from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab_forecast.demo.junction import junction
from cab_forecast.demo.simulation import Simulation
from cab_forecast.demo.ticks import HISTORY_SECONDS, SimulatedTicks
from cab_forecast.layers import decode_layers, encode_layers

__all__ = ["demo_request"]

NOW = 1_700_000_000.0
"""Seconds since the epoch."""
_RATE = 10.0
_USERS = 15
_SEED = 5
_BEFORE = 13.5
"""s that the scene has moved before the histories begin."""


def demo_request(time: float = NOW) -> PredictRequest:
    """Build a request of a moment at the simulated junction, with its map.

    Args:
        time: the present, seconds since the epoch, at which the histories end.
    """
    request = PredictRequest()
    request.CopyFrom(_moment())
    request.time = time
    request.scene_id = "demo"
    for agent in request.agents:
        for state in agent.states:
            state.time += time
    return request


@cache
def _moment() -> PredictRequest:
    """Return the request at time 0."""
    ticks = SimulatedTicks(Simulation(junction(), _SEED, _USERS), _RATE)
    first = round((_BEFORE + HISTORY_SECONDS) * _RATE)
    for number in range(-first, 0):
        ticks.tick(number / _RATE)
    request = ticks.tick(0.0)
    raster = request.scene_raster  # as a PNG, so that the request is small as JSON, too
    raster.image.CopyFrom(encode_layers(decode_layers(raster.image, raster.rows, raster.columns), "png"))
    return request
