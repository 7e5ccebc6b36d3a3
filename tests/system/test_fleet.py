"""A fleet under load: calls go to all replicas, and none is lost when one is killed."""

import asyncio
from pathlib import Path

import pytest

from cab_forecast import AsyncClient
from tests.service.requests import make_request
from tests.system.fleet import Fleet, fleet, until, up

pytestmark = pytest.mark.system
_CALLERS = 4
_CALLS = 150


async def load(endpoint: str, calls: int, done: asyncio.Event, after: int) -> None:
    """Send calls one after the other; set the event after some of them.

    Raises:
        ForecastError: a call failed although the client retried it.
    """
    async with AsyncClient(endpoint, timeout=20, retries=4) as client:
        for number in range(calls):
            request = make_request(3, seed=number)
            request.scene_id = f"{endpoint}-{number % 5}"
            response = await client.predict(request)
            assert len(response.forecasts) == 3
            if number == after:
                done.set()


async def test_no_call_is_lost_when_a_replica_is_killed(tmp_path: Path) -> None:
    # Connections are renewed so often that GOAWAY, too, falls among the calls.
    async with fleet(tmp_path, max_connection_age=0.5, allow_anyone="true") as made:
        begun = [asyncio.Event() for _ in range(2 * _CALLERS)]
        endpoints = [made.grpc, made.rest] * _CALLERS
        async with asyncio.TaskGroup() as group:
            for endpoint, event in zip(endpoints, begun, strict=True):
                group.create_task(load(endpoint, _CALLS, event, _CALLS // 3))
            for event in begun:
                await event.wait()
            shares = await asyncio.to_thread(lambda: [made.calls(each) for each in made.replicas])
            made.replicas[1].process.kill()
            await until(lambda: up(made) == {"grpc": 1, "rest": 1}, "HAProxy sees that one is gone")
        assert min(shares) > 0.2 * sum(shares), shares
        assert (await left(made)) > shares[0]


async def left(made: Fleet) -> float:
    """Return the number of calls that the replica which lives has answered."""
    return await asyncio.to_thread(made.calls, made.replicas[0])
