"""Forecasts go on while the track memory is broken: ``python -m loadtest.faults``.

A server with a Redis of its own is called at a steady rate while that Redis is killed, filled, slowed down
and stopped. No forecast may fail, and tracking must come back by itself.
"""

import asyncio
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Annotated, NamedTuple

import httpx
import psutil
import typer
from prometheus_client.parser import text_string_to_metric_families

from cab_forecast import AsyncClient, Tracking
from loadtest.breakage import BreakableRedis, breakable_redis
from loadtest.fault_report import Held, Outcome, Report, show
from loadtest.load import Call, SteadyLoad
from loadtest.servers import Server, serving

MODEL = "kalman"
_ERRORS = "forecast_track_store_errors_total"
_PATIENCE = 10.0
"""s more that tracking may take to come back, beyond its phase."""
_WARM_UP = 1.0
"""s of calls that are not counted."""
_LOOK = 0.05
"""s between looks at whether it is back."""


class Phase(NamedTuple):
    """What is done to Redis, and for how long."""

    name: str
    begin: Callable[[BreakableRedis], None]
    share: float
    """Of the whole run's time."""
    well: bool
    """Whether tracking must come back in it."""


PHASES = (
    Phase("healthy", BreakableRedis.nothing, 0.16, well=True),
    Phase("killed", BreakableRedis.kill, 0.1, well=False),
    Phase("started empty", BreakableRedis.start_empty, 0.11, well=True),
    Phase("full", BreakableRedis.fill, 0.1, well=False),
    Phase("freed", BreakableRedis.free, 0.11, well=True),
    Phase("slow", BreakableRedis.slow, 0.1, well=False),
    Phase("quick again", BreakableRedis.quick, 0.11, well=True),
    Phase("hanging", BreakableRedis.hang, 0.1, well=False),
    Phase("awake again", BreakableRedis.wake, 0.11, well=True),
)


async def rehearse(
    server: Server, redis: BreakableRedis, seconds: float, rate: float, scenes: int, agents: int
) -> Report:
    """Goes through all phases.

    Args:
        server: that forecasts, with that Redis as its track memory.
        redis: as it breaks.
        seconds: of all phases together; more where tracking takes long to come back.
        rate: calls/s.
        scenes: how many there are.
        agents: of each scene.
    """
    begins: list[float] = []
    recovered: list[float | None] = []
    async with (
        AsyncClient(f"grpc://{server.grpc}", retries=0) as client,
        httpx.AsyncClient(base_url=f"http://{server.http}") as http,
        asyncio.TaskGroup() as group,
    ):
        load, stop = SteadyLoad(client, MODEL, rate, scenes, agents), asyncio.Event()
        group.create_task(load.run(stop))
        try:
            await asyncio.sleep(_WARM_UP)
            errors = [await _errors(http)]
            before = await asyncio.to_thread(_held, server, redis)
            for phase in PHASES:
                # Until Redis is as the phase wants it, calls belong to the one before
                await asyncio.to_thread(phase.begin, redis)
                begins.append(time.perf_counter())
                await asyncio.sleep(phase.share * seconds)
                recovered.append(await _recovery(load, begins[-1], _PATIENCE if phase.well else 0.0))
                errors.append(await _errors(http))
            after = await asyncio.to_thread(_held, server, redis)
        finally:
            stop.set()
    calls = _by_phase(load.calls, begins)
    counts = [new - old for old, new in pairwise(errors)]
    outcomes = [
        Outcome(phase.name, phase.well, *rest)
        for phase, rest in zip(PHASES, zip(calls, counts, recovered, strict=True), strict=True)
    ]
    return Report(outcomes, before, after, server.errors())


def run(seconds: float, rate: float, scenes: int, agents: int) -> Report:
    """Starts what is needed and goes through all phases; arguments as in ``rehearse``."""
    with (
        tempfile.TemporaryDirectory() as no_models,
        breakable_redis() as redis,
        serving(Path(no_models), store=redis.url) as server,
    ):
        return asyncio.run(rehearse(server, redis, seconds, rate, scenes, agents))


def _by_phase(calls: list[Call], begins: list[float]) -> list[list[Call]]:
    """Calls of each phase; those before the first one are left out."""
    bounds = pairwise([*begins, float("inf")])
    return [[call for call in calls if begin <= call.sent < end] for begin, end in bounds]


async def _recovery(load: SteadyLoad, since: float, patience: float) -> float | None:
    """s until each scene was tracked as usual; None: after s more of patience one still is not."""
    for _ in range(round(patience / _LOOK) + 1):
        first: dict[int, float] = {}
        for call in load.calls:
            if call.sent >= since and call.tracking is Tracking.OK:
                first.setdefault(call.scene, call.sent + call.seconds - since)
        if len(first) == load.scenes:
            return max(first.values())
        await asyncio.sleep(_LOOK)
    return None


async def _errors(http: httpx.AsyncClient) -> "Counter[str]":
    """The track memory's errors so far, by reason."""
    text = (await http.get("/metrics")).raise_for_status().text
    counted: Counter[str] = Counter()
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            if sample.name == _ERRORS:
                counted[sample.labels["reason"]] += round(sample.value)
    return counted


def _held(server: Server, redis: BreakableRedis) -> Held:
    process = psutil.Process(server.process.pid)
    connections = redis.connections()
    return Held(
        connections,
        process.num_fds() - connections,
        process.num_threads(),
        process.memory_info().rss,
    )


def main(
    seconds: Annotated[float, typer.Option(min=1, help="of all phases together")] = 60.0,
    rate: Annotated[float, typer.Option(min=1, help="calls/s")] = 40.0,
    scenes: Annotated[int, typer.Option(min=1)] = 4,
    agents: Annotated[int, typer.Option(min=1, help="of each scene")] = 8,
) -> None:
    """Prints a row a phase; fails if a forecast did, or if tracking did not come back."""
    report = run(seconds, rate, scenes, agents)
    show(report)
    problems = report.problems()
    for problem in problems:
        typer.echo(problem, err=True)
    if problems:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
