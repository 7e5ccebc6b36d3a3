"""Made-up traffic on ring roads, sent to a server as a driving stack would."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest, SceneRaster
from cab_forecast import Client, ForecastError, agent, predict_request, scene_raster

SCENE = "rings"
_HISTORY = np.arange(-4, 1) * 0.5
_PIXELS_PER_METER = 3.0
_HALF = 80.0  # m, of the map
_WIDTH = 3.5  # m, of a lane


def rings_raster() -> SceneRaster:
    """Return ring roads of two lanes, every 12 m, in all three layers."""
    pixels = int(2 * _HALF * _PIXELS_PER_METER)
    at = np.arange(pixels) / _PIXELS_PER_METER - _HALF
    off_road = np.abs(np.hypot(at[:, None], at[None, :]) % 12.0 - 6.0)
    layers = np.stack([off_road < _WIDTH, off_road > 5.8, off_road < 0.2])
    return scene_raster(layers.astype(np.uint8), (-_HALF, -_HALF), _PIXELS_PER_METER)


def ring_agent(number: int, now: float) -> Agent:
    """Return an agent that drives along a ring, with 2 s of history at 2 Hz.

    Every seventh has one observation only, every ninth is context only, and every fourth is a pedestrian.
    """
    radius = 18.0 + 12.0 * (number % 5) + (1.75 if number % 2 else -1.75)
    kind = "pedestrian" if number % 4 == 3 else "vehicle"
    speed = 1.4 if kind == "pedestrian" else 4.0 + number % 3 * 2.0
    direction = 1.0 if number % 2 else -1.0
    times = now + (_HISTORY[-1:] if number % 7 == 6 else _HISTORY)
    angle = number * 2.4 + direction * speed / radius * (times % 10_000.0)
    return agent(
        f"{kind}-{number:02d}",
        kind,  # type: ignore[arg-type]  # one of the literals
        times,
        radius * np.stack([np.cos(angle), np.sin(angle)], axis=1),
        headings=angle + direction * np.pi / 2,
        velocities=direction * speed * np.stack([-np.sin(angle), np.cos(angle)], axis=1),
        predict=number % 9 != 8,
    )


def ring_request(
    now: float, agents: int, raster: SceneRaster | None = None, model: str = ""
) -> PredictRequest:
    """Return the request of one tick."""
    made = [ring_agent(number, now) for number in range(agents)]
    return predict_request(now, made, scene_id=SCENE, model=model, raster=raster)


@dataclass
class Traffic:
    """Calls at a steady rate, in a thread of their own. Calls that fail are left out."""

    endpoint: str
    agents: int
    hertz: float = 10.0
    model: str = ""
    token: str | None = None
    sent: int = 0
    """Calls that were answered."""
    _stop: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Send ticks until it is stopped."""
        raster = rings_raster()
        # Ticks on a grid of whole multiples: the track memory finds forecasts of every age
        tick = int(time.time() * self.hertz)
        with Client(self.endpoint, token=self.token, timeout=5.0, retries=0) as client:
            while not self._stop.wait(max(tick / self.hertz - time.time(), 0.0)):
                try:
                    client.predict(ring_request(tick / self.hertz, self.agents, raster, self.model))
                    self.sent += 1
                except ForecastError:
                    self._stop.wait(0.2)
                tick = max(tick + 1, int(time.time() * self.hertz))

    def stop(self) -> None:
        """Send no further tick."""
        self._stop.set()


@contextmanager
def traffic(endpoint: str, agents: int, **options: object) -> Iterator[Traffic]:
    """Send traffic while the context lasts."""
    made = Traffic(endpoint, agents, **options)  # type: ignore[arg-type]
    thread = threading.Thread(target=made.run, name="traffic")
    thread.start()
    try:
        yield made
    finally:
        made.stop()
        thread.join()


if __name__ == "__main__":
    import sys

    Traffic(sys.argv[1], int(sys.argv[2])).run()
