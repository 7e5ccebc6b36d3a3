"""The demo that moves: a scene whose ticks are forecast by a server, in real time."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab_forecast.client import Client
from cab_forecast.demo.ticks import Ticks
from cab_forecast.errors import ForecastError

_LOST = 5.0
"""Lag from which on the scene goes on where it was instead of catching up, s."""


@dataclass
class Progress:
    """Calls and failures of a demo in the last seconds."""

    calls: int = 0
    agents: int = 0
    """Forecast in the last call."""
    skipped: int = 0
    """Ticks that were not sent, because calls before them took too long."""
    seconds: list[float] = field(default_factory=list)
    """Duration of each call, s."""
    error: ForecastError | None = None
    """Error of the last call, if it failed."""


def play(client: Client, ticks: Ticks, seconds: float | None = None) -> Iterator[Progress]:
    """Forecast the ticks of a scene in real time; yield what was done in each second.

    A tick that comes due while a call is in progress is simulated but not sent: the scene never lags behind
    the clock. A call that fails does not end the demo, so it survives a restart of the server.

    Args:
        client: client of the server.
        ticks: the scene.
        seconds: duration; None: without end.
    """
    period = 1 / ticks.rate
    epoch, start = time.time(), time.monotonic()
    done = Progress()
    number = 0
    while seconds is None or number * period < seconds:
        due = start + number * period
        request = ticks.tick(epoch + number * period)
        late = time.monotonic() - due
        if late < 0:
            time.sleep(-late)
        if late > period and late < _LOST:
            done.skipped += 1
        elif late >= _LOST:  # the machine has slept
            epoch, start = epoch + late, start + late
        else:
            _call(client, request, done)
        number += 1
        if number % max(round(ticks.rate), 1) == 0:
            yield done
            done = Progress()


def _call(client: Client, request: PredictRequest, done: Progress) -> None:
    began = time.perf_counter()
    try:
        response = client.predict(request)
    except ForecastError as error:
        done.error = error
        return
    done.error = None
    done.calls += 1
    done.agents = len(response.forecasts)
    done.seconds.append(time.perf_counter() - began)
