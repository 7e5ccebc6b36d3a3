"""20,000 streams that clients leave: the server's process holds as much as before."""

import asyncio
import re
from pathlib import Path

import httpx
import psutil
import pytest

from loadtest.servers import Server, serving
from tests.service.cancelled_streams import leave_grpc_streams, leave_rest_streams
from tests.system.fleet import until

pytestmark = pytest.mark.system
_STREAMS = 10_000
"""Streams for each transport."""
_GROWTH = 24 * 2**20
"""Bytes; 20,000 streams of 2 KiB each would be more."""


def held(server: Server) -> tuple[int, int, int]:
    """Return open files, threads and resident bytes of the process."""
    process = psutil.Process(server.process.pid)
    return process.num_fds(), process.num_threads(), process.memory_info().rss


async def leave(server: Server, streams: int) -> None:
    """Leave streams on both transports."""
    await leave_grpc_streams(server.grpc, streams)
    await leave_rest_streams(server.http, streams)


async def test_cancelled_streams_leak_nothing(tmp_path: Path) -> None:
    with serving(tmp_path, default_model="kalman", max_watchers=1000) as server:
        await leave(server, 1000)  # pools and caches are as large as they get
        files, threads, resident = held(server)
        await leave(server, _STREAMS)
        await until(lambda: held(server)[0] <= files + 2, "files are closed")
        after = held(server)
        print(  # noqa: T201 - the figures
            f"{files} → {after[0]} files, {threads} → {after[1]} threads, "
            f"{resident / 2**20:.1f} → {after[2] / 2**20:.1f} MiB"
        )
        assert after[1] <= threads
        assert after[2] <= resident + _GROWTH
        text = (await asyncio.to_thread(httpx.get, f"http://{server.http}/metrics")).text
        # Those that began were counted; others were gone before their request was read
        for transport in ("grpc", "rest"):
            labels = f'code="CANCELLED",method="WatchScene",transport="{transport}"'
            [left] = re.findall(rf"^forecast_requests_total{{{labels}}} (\S+)$", text, re.MULTILINE)
            assert float(left) >= _STREAMS / 2
        assert not server.errors()
