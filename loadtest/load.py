"""Calls at a steady rate, whatever becomes of the ones before."""

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
    """On the clock of ``time.perf_counter``, s."""
    seconds: float
    scene: int
    failure: str
    """What became of its forecasts; empty: all are there."""
    tracking: Tracking


@dataclass
class SteadyLoad:
    """Calls of several scenes in turn, in real time.

    Args:
        client: by which they go; it should not try again.
        model: that is asked for.
        rate: calls/s, of all scenes together.
        scenes: how many.
        agents: of each.
    """

    client: AsyncClient
    model: str
    rate: float
    scenes: int
    agents: int
    calls: list[Call] = field(default_factory=list)
    """Those that have ended, in that order."""

    async def run(self, stop: asyncio.Event) -> None:
        """Calls until told to stop, and waits for the last answers."""
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
        sent, told, failure = time.perf_counter(), Tracking.UNSPECIFIED, ""
        try:
            response = await self.client.predict(request)
        except ForecastError as error:
            failure = f"{error.code}: {error}"
        else:
            told = tracking(response)
            made = [forecast.status for forecast in forecasts(response).values()]
            if len(made) < self.agents or any(status not in _FORECAST for status in made):
                failure = f"forecasts: {', '.join(made)}"
        self.calls.append(Call(sent, time.perf_counter() - sent, scene, failure, told))
