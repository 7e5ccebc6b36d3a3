"""The HTTP server."""

import asyncio
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from fastapi import FastAPI

from service.settings import split_address

_POLL = 0.005
_SHORTEST_GRACE = 0.1
"""s; with none at all uvicorn would not even look whether there is anything to wait for."""


class HttpServer:
    """uvicorn on a socket of ours, stopped by us and not by signals."""

    def __init__(self, app: FastAPI, address: str) -> None:
        self._wanted = address
        self._server = _Uvicorn(
            uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                lifespan="off",
                ws="none",
                server_header=False,
            )
        )
        self._task: asyncio.Task[None] | None = None
        self.address = ""
        """HOST:PORT that is listened on."""

    async def start(self) -> None:
        """Listens; calls are answered from now on.

        Raises:
            OSError: the port is taken or the host is not ours.
        """
        listener = _listen(self._wanted)
        host = self._wanted.rpartition(":")[0]
        self.address = f"{host}:{listener.getsockname()[1]}"
        self._task = asyncio.create_task(self._server.serve(sockets=[listener]), name="http")
        # uvicorn tells nobody when it has started but by a flag
        while not self._server.started and not self._task.done():  # noqa: ASYNC110
            await asyncio.sleep(_POLL)

    async def stop(self, grace: float) -> None:
        """Takes no more connections and gives the answers under way so many seconds."""
        if self._task is None:
            return
        self._server.config.timeout_graceful_shutdown = max(grace, _SHORTEST_GRACE)  # type: ignore[assignment]  # fractions do
        self._server.should_exit = True
        await self._task
        self._server.abort_connections()


class _Uvicorn(uvicorn.Server):
    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """None: signals are for the whole process, of which HTTP is a part."""
        yield

    def abort_connections(self) -> None:
        """Drops those that the grace was too short for; uvicorn leaves them to the end of the process."""
        for connection in list(self.server_state.connections):
            transport = connection.transport
            if transport is not None:
                transport.abort()


def _listen(address: str) -> socket.socket:
    host, port = split_address(address)
    family, kind, protocol, _, where = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(where)
        listener.listen(2048)
        listener.setblocking(False)
    except OSError:
        listener.close()
        raise
    return listener
