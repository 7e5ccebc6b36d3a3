"""Calls at a steady rate, independent of the results of earlier calls."""

import asyncio
import time
from dataclasses import dataclass, field
from typing import NamedTuple

from cab_forecast import AsyncClient, ForecastError, Tracking, predict_request, tracking
from cab_forecast.forecast import Status, forecasts
from loadtest.traffic import START, Traffic

_STATES = 5
_FORECAST = (Status.OK, Status.SHORT_HISTORY)


class Call(NamedTuple):
    """One call."""

    sent: float
    """Start on the clock of ``time.perf_counter``, s."""
    seconds: float
    """Latency."""
    scene: int
    failure: str
    """Failure of the forecasts; empty: all were made."""
    tracking: Tracking


@dataclass
class SteadyLoad:
    """Calls of several scenes in turn, in real time.

    Args:
        client: client without retries.
        model: requested model.
        rate: calls/s of all scenes together.
        scenes: number of scenes.
        agents: agents per scene.
    """

    client: AsyncClient
    model: str
    rate: float
    scenes: int
    agents: int
    calls: list[Call] = field(default_factory=list)
    """Finished calls, in the order of their ends."""

    async def run(self, stop: asyncio.Event) -> None:
        """Call until the event is set, then wait for the last responses."""
        traffic = [Traffic(self.agents, seed) for seed in range(self.scenes)]
        begin, number = time.perf_counter(), 0
        async with asyncio.TaskGroup() as group:
            while not stop.is_set():
                scene = number % self.scenes
                group.create_task(self._call(scene, START + number / self.rate, traffic[scene]))
                number += 1
                await asyncio.sleep(begin + number / self.rate - time.perf_counter())

    async def _call(self, scene: int, now: float, traffic: Traffic) -> None:
        request = predict_request(
            now, traffic.agents(now, _STATES), scene_id=f"scene-{scene}", model=self.model, merge=False
        )
        sent, status, failure = time.perf_counter(), Tracking.UNSPECIFIED, ""
        try:
            response = await self.client.predict(request)
        except ForecastError as error:
            failure = f"{error.code}: {error}"
        else:
            status = tracking(response)
            made = [forecast.status for forecast in forecasts(response).values()]
            if len(made) < self.agents or any(forecast not in _FORECAST for forecast in made):
                failure = f"forecasts: {', '.join(made)}"
        self.calls.append(Call(sent, time.perf_counter() - sent, scene, failure, status))
