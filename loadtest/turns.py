"""What the track memory adds to a call: the same calls with and without it, in turns."""

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
"""Of an agent's history."""
WARM_UP = 17
"""Calls that are not counted: 8 s. Sets settle after 12, and from then on as much is forgotten as comes."""
_COUNTED = 10
"""Calls over which round trips are counted."""

Way = Literal["untracked", "tracked", "recalled"]
"""Without a scene_id; with one; with one, a single state an agent, and the history from the memory."""


class Turn(NamedTuple):
    """Which server is called, and how."""

    store: str
    way: Way


class Added(NamedTuple):
    """The median of what calls took longer than others, ms, and the bounds of its 95 % interval."""

    median: float
    low: float
    high: float


@dataclass
class Times:
    """Of calls."""

    seconds: list[float] = field(default_factory=list)
    """One a round."""
    unavailable: int = 0
    """Calls that the memory did not answer in time."""

    def quantile_ms(self, share: float) -> float:
        """Of the calls' time."""
        return 1e3 * float(np.quantile(self.seconds, share))

    def added(self, without: "Times") -> Added:
        """What these took longer than others in the same rounds: a busy machine meets both alike."""
        more = np.sort(1e3 * (np.array(self.seconds) - without.seconds))
        # So many standard deviations of a binomial distribution off the middle one
        off = round(1.96 * math.sqrt(len(more)) / 2)
        middle = len(more) // 2
        low, high = max(middle - off, 0), min(middle + off, len(more) - 1)
        return Added(float(np.median(more)), float(more[low]), float(more[high]))


class Turns:
    """Calls of a scene with ``AGENTS`` vehicles, 2 a second of its time.

    Args:
        stores: the servers.
        ways: how each is called.
        model: that is asked for.
    """

    def __init__(self, stores: Sequence[Store], ways: Sequence[Way], model: str) -> None:
        self._stores = {store.name: store for store in stores}
        self._turns = [Turn(name, way) for name in self._stores for way in ways]
        self._model = model
        self._traffic = Traffic(AGENTS)
        self._frame = 0
        self._random = random.Random(0)  # noqa: S311 - for the order
        self.measure(WARM_UP)

    def measure(self, rounds: int) -> dict[Turn, Times]:
        """So many calls of each server in each way, in an order that is drawn anew for each round: what comes
        after another call to the same server finds it warmer."""
        times = {turn: Times() for turn in self._turns}
        for _ in range(rounds):
            requests = self._next()
            for turn in self._random.sample(self._turns, len(self._turns)):
                begin = time.perf_counter()
                response = self._stores[turn.store].client.predict(requests[turn.way])
                times[turn].seconds.append(time.perf_counter() - begin)
                times[turn].unavailable += _check(response, turn.way)
        return times

    def round_trips(self) -> dict[Turn, float]:
        """To Redis, a call."""
        all_requests = [self._next() for _ in range(_COUNTED)]
        trips = {}
        for turn in self._turns:
            store = self._stores[turn.store]
            before = store.round_trips()
            for requests in all_requests:
                store.client.predict(requests[turn.way])
            trips[turn] = (store.round_trips() - before) / _COUNTED
        return trips

    def forget(self) -> None:
        """Leaves nothing of it in the servers."""
        for store in self._stores.values():
            for way in ("tracked", "recalled"):
                store.client.reset_scene(self._scene_id(way))

    def _scene_id(self, way: Way) -> str:
        return f"{self._model}-{way}"

    def _next(self) -> dict[Way, PredictRequest]:
        """The next time's requests."""
        now = START + STEP * self._frame
        self._frame += 1
        whole, newest = self._traffic.agents(now, STATES), self._traffic.agents(now, 1)
        ask = partial(predict_request, now, model=self._model, merge=False)
        return {
            "untracked": ask(whole),
            "tracked": ask(whole, scene_id=self._scene_id("tracked")),
            "recalled": ask(newest, scene_id=self._scene_id("recalled"), history="memory"),
        }


def _check(response: PredictResponse, way: Way) -> bool:
    """Whether the memory did not answer.

    Raises:
        RuntimeError: a forecast is missing.
    """
    made = [forecast.status for forecast in forecasts(response).values()]
    if len(made) != AGENTS or any(status not in (Status.OK, Status.SHORT_HISTORY) for status in made):
        raise RuntimeError(f"forecasts are missing: {made}")
    return way != "untracked" and tracking(response) is Tracking.UNAVAILABLE
