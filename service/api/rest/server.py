"""The HTTP server."""

import asyncio
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from fastapi import FastAPI

from service.settings import split_address

_POLL = 0.005


class HttpServer:
    """uvicorn on a socket of ours, stopped by us and not by signals."""

    def __init__(self, app: FastAPI, address: str, flush_seconds: int) -> None:
        self._wanted = address
        self._server = _Uvicorn(
            uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                lifespan="off",
                ws="none",
                server_header=False,
                timeout_graceful_shutdown=flush_seconds,
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

    async def stop(self) -> None:
        """Takes no more connections and waits for the calls under way."""
        if self._task is not None:
            self._server.should_exit = True
            await self._task


class _Uvicorn(uvicorn.Server):
    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """None: signals are for the whole process, of which HTTP is a part."""
        yield


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
