"""A Redis that is broken on purpose, and mended."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import redis

from loadtest.stores import redis_server
from tests.service.tracking.store.redis_servers import FaultProxy, Process, until

DELAY = 0.05
"""s that a slow network takes each way; a call waits 20 ms for both."""

_ROOM = 8 * 2**20
"""Bytes that are free before others fill them."""
_BALLAST = tuple(4**power for power in range(9, 1, -1))
"""Bytes of what they fill it with: large, then ever smaller to the last bit."""


class BreakableRedis:
    """A Redis and the network before it. Each call of it takes a moment: not for the event loop.

    Args:
        server: it.
        proxy: the way to it.
        log: where it writes its log, if it is started again.
    """

    def __init__(self, server: Process, proxy: FaultProxy, log: Path) -> None:
        self._server = server
        self._proxy = proxy
        self._log = log
        self._ballast: list[str] = []

    @property
    def url(self) -> str:
        """Its address, by way of the network."""
        return self._proxy.url

    def connections(self) -> int:
        """How many the server that forecasts has to it."""
        return self._server.text("CLIENT LIST").count("name=cab-forecast ")

    def used_memory(self) -> int:
        """Bytes."""
        told = self._server.text("INFO memory")
        return int(next(line for line in told.splitlines() if line.startswith("used_memory:")).split(":")[1])

    def nothing(self) -> None:
        """All is well."""

    def kill(self) -> None:
        """It is gone, and what it held."""
        self._server.kill()

    def start_empty(self) -> None:
        """Another one is in its place, which holds nothing."""
        with self._log.open("ab") as log:
            self._server.process = subprocess.Popen(  # noqa: S603
                self._server.process.args, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        until(lambda: self._server.command("PING") == b"PONG")

    def fill(self) -> None:
        """Others fill its memory to the last bit, and it drops nothing."""
        self._server.command("CONFIG", "SET", "maxmemory-policy", "noeviction")
        self._server.command("CONFIG", "SET", "maxmemory", self.used_memory() + _ROOM)
        for size in _BALLAST:
            try:
                while True:
                    self._server.command("SET", f"ballast:{len(self._ballast)}", "x" * size)
                    self._ballast.append(f"ballast:{len(self._ballast)}")
            except redis.OutOfMemoryError:
                pass

    def free(self) -> None:
        """What others filled it with is gone; the limit stays."""
        self._server.command("DEL", *self._ballast)
        self._ballast.clear()

    def slow(self) -> None:
        """The network is slow."""
        self._proxy.set("slow", DELAY)

    def quick(self) -> None:
        """It no longer is."""
        self._proxy.set("pass")

    def hang(self) -> None:
        """It keeps its connections and answers nothing."""
        self._server.pause()

    def wake(self) -> None:
        """It goes on where it was."""
        self._server.resume()


@contextmanager
def breakable_redis() -> Iterator[BreakableRedis]:
    """One on free ports.

    Raises:
        typer.Exit: none is installed.
    """
    with redis_server() as server, FaultProxy(server.port) as proxy:
        yield BreakableRedis(server, proxy, server.folder / "log")
