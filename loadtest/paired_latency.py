"""Latency that the track memory adds: the same calls with and without it, in random order."""

import math
import random
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal, NamedTuple

import numpy as np

from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse
from cab_forecast import Tracking, forecasts, predict_request, tracking
from cab_forecast.forecast import Status
from loadtest.stores import Store
from loadtest.traffic import START, STEP, Traffic

AGENTS = 32
STATES = 5
"""States in an agent's history."""
WARM_UP = 17
"""Calls before the measurement, 8 s of the scene; after 12, sets settle and as much expires as arrives."""
_TRIP_CALLS = 10
"""Calls over which round trips are averaged."""

Mode = Literal["untracked", "tracked", "recalled"]
"""Without a scene_id; with one; with one, a single state per agent, and the history from the track memory."""


class Variant(NamedTuple):
    """Server and mode of a call."""

    store: str
    mode: Mode


class AddedLatency(NamedTuple):
    """Median of the added latency, ms, with the bounds of its 95 % confidence interval."""

    median: float
    low: float
    high: float


@dataclass
class Latencies:
    """Latencies of one variant."""

    seconds: list[float] = field(default_factory=list)
    """One per round."""
    unavailable: int = 0
    """Calls for which the track memory was unavailable."""

    def quantile_ms(self, share: float) -> float:
        """Return a quantile of the latencies."""
        return 1e3 * float(np.quantile(self.seconds, share))

    def added_to(self, baseline: "Latencies") -> AddedLatency:
        """Return the latency added to a baseline in the same rounds, so that machine load cancels out."""
        added = np.sort(1e3 * (np.array(self.seconds) - baseline.seconds))
        # 1.96 standard deviations of a binomial distribution around the middle rank
        offset = round(1.96 * math.sqrt(len(added)) / 2)
        middle = len(added) // 2
        low, high = max(middle - offset, 0), min(middle + offset, len(added) - 1)
        return AddedLatency(float(np.median(added)), float(added[low]), float(added[high]))


class PairedLatency:
    """Calls of a scene with ``AGENTS`` vehicles, every ``STEP`` seconds of scene time, to all variants.

    Args:
        stores: the servers.
        modes: modes of the calls to each server.
        model: requested model.
    """

    def __init__(self, stores: Sequence[Store], modes: Sequence[Mode], model: str) -> None:
        self._stores = {store.name: store for store in stores}
        self._variants = [Variant(name, mode) for name in self._stores for mode in modes]
        self._model = model
        self._traffic = Traffic(AGENTS)
        self._frame = 0
        self._random = random.Random(0)  # noqa: S311 - for the order
        self.measure(WARM_UP)

    def measure(self, rounds: int) -> dict[Variant, Latencies]:
        """Call each variant once per round and return the latencies.

        The order is drawn anew for each round, because a call that follows another one to the same server is
        faster.
        """
        latencies = {variant: Latencies() for variant in self._variants}
        for _ in range(rounds):
            requests = self._next_requests()
            for variant in self._random.sample(self._variants, len(self._variants)):
                begin = time.perf_counter()
                response = self._stores[variant.store].client.predict(requests[variant.mode])
                latencies[variant].seconds.append(time.perf_counter() - begin)
                latencies[variant].unavailable += _unavailable(response, variant.mode)
        return latencies

    def round_trips(self) -> dict[Variant, float]:
        """Return the round trips to Redis per call of each variant."""
        all_requests = [self._next_requests() for _ in range(_TRIP_CALLS)]
        trips = {}
        for variant in self._variants:
            store = self._stores[variant.store]
            before = store.round_trips()
            for requests in all_requests:
                store.client.predict(requests[variant.mode])
            trips[variant] = (store.round_trips() - before) / _TRIP_CALLS
        return trips

    def reset(self) -> None:
        """Delete the scenes of this measurement from the servers."""
        for store in self._stores.values():
            for mode in ("tracked", "recalled"):
                store.client.reset_scene(self._scene_id(mode))

    def _scene_id(self, mode: Mode) -> str:
        return f"{self._model}-{mode}"

    def _next_requests(self) -> dict[Mode, PredictRequest]:
        """Return the requests of the next frame."""
        now = START + STEP * self._frame
        self._frame += 1
        whole, newest = self._traffic.agents(now, STATES), self._traffic.agents(now, 1)
        request = partial(predict_request, now, model=self._model, merge=False)
        return {
            "untracked": request(whole),
            "tracked": request(whole, scene_id=self._scene_id("tracked")),
            "recalled": request(newest, scene_id=self._scene_id("recalled"), history="memory"),
        }


def _unavailable(response: PredictResponse, mode: Mode) -> bool:
    """Return whether the track memory was unavailable.

    Raises:
        RuntimeError: a forecast is missing.
    """
    made = [forecast.status for forecast in forecasts(response).values()]
    if len(made) != AGENTS or any(status not in (Status.OK, Status.SHORT_HISTORY) for status in made):
        raise RuntimeError(f"forecasts are missing: {made}")
    return mode != "untracked" and tracking(response) is Tracking.UNAVAILABLE
