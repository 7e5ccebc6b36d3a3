"""Servers with each kind of track memory, to be compared."""

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil
import redis
import typer

from cab_forecast import Client
from loadtest.servers import serving
from tests.service.tracking.store import redis_servers
from tests.service.tracking.store.redis_servers import HOST, Process

_EXPIRY = 3600
"""s; longer than anything here takes."""
_AGENTS = 50_000
"""More than there are here."""


@dataclass(frozen=True)
class Store:
    """A server, a client of it, and the Redis that is its track memory."""

    name: str
    client: Client
    process: psutil.Process
    """Of the server."""
    redis: Process | None
    """None: the server remembers by itself."""

    def resident(self) -> int:
        """Bytes that the server takes."""
        resident: int = self.process.memory_info().rss
        return resident

    def round_trips(self) -> int:
        """Scripts that Redis was asked for so far; 0 without it."""
        if self.redis is None:
            return 0
        stats = self.redis.text("INFO commandstats").splitlines()
        asked = [line for line in stats if line.startswith(("cmdstat_evalsha:", "cmdstat_eval:"))]
        return sum(int(line.partition("calls=")[2].partition(",")[0]) for line in asked)

    def held(self, scene_ids: str) -> int:
        """Bytes that Redis takes for scenes, by how their ids begin; 0 without it."""
        if self.redis is None:
            return 0
        with redis.Redis(HOST, self.redis.port) as client:
            keys = list(client.scan_iter(match=f"*{{{scene_ids}*", count=1000))
            return sum(client.memory_usage(key, samples=0) or 0 for key in keys)


@contextmanager
def redis_server() -> Iterator[Process]:
    """A Redis on a free port, ended at the end.

    Raises:
        typer.Exit: none is installed.
    """
    if shutil.which("redis-server") is None:
        typer.echo("redis-server is not installed", err=True)
        raise typer.Exit(1)
    with redis_servers.single() as server:
        yield server


@contextmanager
def stores(models: Path) -> Iterator[list[Store]]:
    """A server that remembers by itself, and one with a Redis.

    Args:
        models: folder of their checkpoints; an empty one leaves the baselines.
    """
    with ExitStack() as stack:
        server = stack.enter_context(redis_server())
        found = []
        for name, redis_process in (("in-process", None), ("Redis", server)):
            url = "memory" if redis_process is None else redis_process.url
            process = stack.enter_context(
                serving(models, store=url, track_expiry=_EXPIRY, max_tracked_agents=_AGENTS)
            )
            client = stack.enter_context(Client(f"grpc://{process.grpc}", timeout=30, retries=0))
            found.append(Store(name, client, psutil.Process(process.process.pid), redis_process))
        yield found
