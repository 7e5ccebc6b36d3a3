"""Servers with each kind of track memory, for comparison."""

import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil
import redis
import typer

from cab_forecast import Client
from loadtest import redis_servers
from loadtest.redis_servers import HOST, Process
from loadtest.servers import serving

_EXPIRY = 3600
"""Seconds; longer than any measurement."""
_MAX_AGENTS = 50_000
"""More than any measurement has."""
_QUIET = 0.05
"""s without a script after which none is under way."""


@dataclass(frozen=True)
class Store:
    """A server, its client, and the Redis of its track memory."""

    name: str
    client: Client
    process: psutil.Process
    """Process of the server."""
    redis: Process | None
    """None: the track memory is in-process."""

    def resident(self) -> int:
        """Return the resident memory of the server, bytes."""
        resident: int = self.process.memory_info().rss
        return resident

    def round_trips(self) -> int:
        """Return how often Redis has run append.lua, once it has run all that it was sent; 0 without Redis.

        A script of a call may run after the call's answer, if Redis was late.
        """
        if self.redis is None:
            return 0
        before, now = -1, self._appends(self.redis)
        while now != before:
            time.sleep(_QUIET)
            before, now = now, self._appends(self.redis)
        return now

    @staticmethod
    def _appends(server: Process) -> int:
        # append.lua alone sends HMGET, once a run; the directory of scenes runs a script every second, too
        stats = server.text("INFO commandstats").splitlines()
        reads = (line for line in stats if line.startswith("cmdstat_hmget:"))
        return sum(int(line.partition("calls=")[2].partition(",")[0]) for line in reads)

    def redis_bytes(self, scene_ids: str) -> int:
        """Return the memory of scenes in Redis, bytes; 0 without Redis.

        Args:
            scene_ids: prefix of the scene ids.
        """
        if self.redis is None:
            return 0
        with redis.Redis(HOST, self.redis.port) as client:
            keys = list(client.scan_iter(match=f"*{{{scene_ids}*", count=1000))
            return sum(client.memory_usage(key, samples=0) or 0 for key in keys)


@contextmanager
def redis_server() -> Iterator[Process]:
    """Run a Redis on a free port.

    Raises:
        typer.Exit: Redis is not installed.
    """
    if shutil.which("redis-server") is None:
        typer.echo("redis-server is not installed", err=True)
        raise typer.Exit(1)
    with redis_servers.single() as server:
        yield server


@contextmanager
def stores(models: Path) -> Iterator[list[Store]]:
    """Run a server with in-process track memory, and one with Redis.

    Args:
        models: folder of their checkpoints; if it is empty, they have the baselines only.
    """
    with ExitStack() as stack:
        server = stack.enter_context(redis_server())
        started = []
        for name, redis_process in (("in-process", None), ("Redis", server)):
            url = "memory" if redis_process is None else redis_process.url
            process = stack.enter_context(
                serving(models, store=url, track_expiry=_EXPIRY, max_tracked_agents=_MAX_AGENTS)
            )
            client = stack.enter_context(Client(f"grpc://{process.grpc}", timeout=30, retries=0))
            started.append(Store(name, client, psutil.Process(process.process.pid), redis_process))
        yield started
