"""Streams that clients leave hold nothing."""

import asyncio
import gc

import psutil
import pytest

from service.server import Server
from tests.service.cancelled_streams import leave_grpc_streams, leave_rest_streams
from tests.service.servers import count, running, until

STREAMS = 250
_WATCHERS = 100
"""Max number of streams; places that were not given back would be missed."""


async def leave(server: Server, transport: str, streams: int) -> None:
    if transport == "grpc":
        await leave_grpc_streams(server.grpc_address, streams)
    else:
        await leave_rest_streams(server.http_address, streams)


def held() -> tuple[int, int]:
    """Return the number of tasks on the loop, and of open files."""
    gc.collect()
    return len(asyncio.all_tasks()), psutil.Process().num_fds()


@pytest.mark.parametrize("transport", ["grpc", "rest"])
async def test_streams_that_clients_leave_hold_nothing(transport: str) -> None:
    async with running(max_batch_agents=2, max_watchers=_WATCHERS) as server:
        await leave(server, transport, 20)
        await asyncio.sleep(0.2)
        tasks, files = held()
        await leave(server, transport, STREAMS)
        await until(lambda: held()[0] <= tasks)
        await until(lambda: held()[1] <= files + 2)
        # Streams that begin were counted, as cancelled by their clients; none failed
        assert count(server, transport, "WatchScene", "CANCELLED") >= STREAMS / 2
        assert count(server, transport, "WatchScene", "INTERNAL") == 0
        assert count(server, transport, "WatchScene", "RESOURCE_EXHAUSTED") == 0
