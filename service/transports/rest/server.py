"""HTTP application and server."""

import asyncio
import functools
import resource
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import prometheus_client
import uvicorn
from fastapi import FastAPI
from fastapi_offline import FastAPIOffline
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from service.errors import BadField, MethodNotAllowed, NotFound, ServiceError, Unavailable
from service.predict.dataplane import DataPlane
from service.settings import Settings, split_address
from service.telemetry.metrics import Metrics
from service.transports.calls import to_service_error
from service.transports.intake import Intake
from service.transports.rest.connections import BoundedProtocol, Connections
from service.transports.rest.endpoints import Endpoints, ExitStackMiddleware
from service.transports.rest.openapi import openapi_document
from service.transports.rest.problem import problem_response

_POLL = 0.005
"""Seconds between looks at uvicorn's started flag."""
_MIN_GRACE = 0.1
"""Seconds. With a grace period of 0 uvicorn would skip the wait for open connections entirely."""
_BACKLOG = 2048


def build_app(dataplane: DataPlane, metrics: Metrics, settings: Settings, intake: Intake) -> FastAPI:
    """Build the application: the contract's routes, probes, metrics and documentation.

    Args:
        dataplane: executes the calls.
        metrics: counts the calls, and is served at ``/metrics``.
        settings: limits and tokens.
        intake: bounds the calls and their bodies.
    """
    document = openapi_document(settings)
    # Serve Swagger UI from local files: vehicle networks often cannot reach a CDN.
    app = FastAPIOffline(
        title=document["info"]["title"],
        version=document["info"]["version"],
        docs_url="/docs",
        redoc_url=None,
        exception_handlers={HTTPException: _on_http_error, Exception: _on_error},
    )
    app.openapi = lambda: document  # type: ignore[method-assign]  # as the FastAPI documentation does
    app.add_middleware(ExitStackMiddleware)
    for route, endpoint in Endpoints(dataplane, metrics, settings, intake).by_route().items():
        app.add_route(route.path, endpoint, methods=[route.verb])

    async def livez(_: Request) -> Response:
        return PlainTextResponse("alive\n")

    async def readyz(_: Request) -> Response:
        try:
            dataplane.require_ready()
        except Unavailable as error:
            return problem_response(error)
        return PlainTextResponse("ready\n")

    async def show_metrics(_: Request) -> Response:
        return Response(metrics.render(), media_type=prometheus_client.CONTENT_TYPE_LATEST)

    app.add_route("/livez", livez, methods=["GET"])
    app.add_route("/readyz", readyz, methods=["GET"])
    app.add_route("/metrics", show_metrics, methods=["GET"])
    return app


class HttpServer:
    """uvicorn on a socket that this class opens; stopped by ``stop``, not by signals."""

    def __init__(self, app: FastAPI, settings: Settings) -> None:
        self._configured_address = settings.http
        limits = Connections(
            _max_connections(settings), settings.header_timeout, settings.body_timeout, settings.write_timeout
        )
        protocol: Any = functools.partial(BoundedProtocol, limits)
        self._server = _Uvicorn(
            uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                lifespan="off",
                ws="none",
                http=protocol,
                server_header=False,
            )
        )
        self._task: asyncio.Task[None] | None = None
        self.address = ""
        """HOST:PORT that the server listens on, once started."""

    async def start(self) -> None:
        """Listen and begin to serve.

        Raises:
            OSError: the port is in use, or the host is not an address of this machine.
        """
        listener = _listen(self._configured_address)
        host = self._configured_address.rpartition(":")[0]
        self.address = f"{host}:{listener.getsockname()[1]}"
        self._task = asyncio.create_task(self._server.serve(sockets=[listener]), name="http")
        # uvicorn signals its start only by a flag.
        while not self._server.started and not self._task.done():  # noqa: ASYNC110
            await asyncio.sleep(_POLL)

    async def stop(self, grace: float) -> None:
        """Stop accepting connections, and abort those still open after a grace period.

        Args:
            grace: seconds.
        """
        if self._task is None:
            return
        self._server.config.timeout_graceful_shutdown = max(grace, _MIN_GRACE)  # type: ignore[assignment]  # fractions work
        self._server.should_exit = True
        await self._task
        self._server.abort_connections()


class _Uvicorn(uvicorn.Server):
    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture no signals: they are for the whole process, not for HTTP alone."""
        yield

    def abort_connections(self) -> None:
        """Abort connections that outlasted the grace period, which uvicorn leaves open."""
        for connection in list(self.server_state.connections):
            transport = connection.transport
            if transport is not None:
                transport.abort()


async def _on_http_error(request: Request, exception: Any) -> Response:
    """Return the problem for an error that the framework raised, e.g. for an unknown path."""
    path = request.url.path[:200]
    error: ServiceError
    if exception.status_code == NotFound.http_status:
        error = NotFound(f"no route for {request.method} {path}")
    elif exception.status_code == MethodNotAllowed.http_status:
        error = MethodNotAllowed(f"{path} does not support {request.method}")
    else:
        error = BadField("request", str(exception.detail))
    return problem_response(error, exception.headers)


async def _on_error(request: Request, exception: Exception) -> Response:
    return problem_response(to_service_error(exception, request.url.path))


def _max_connections(settings: Settings) -> int:
    """Return the max number of connections: room for calls that are refused and for probes, beside all calls
    in progress, as far as the process may open files."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = 2 * (settings.max_concurrent_calls + settings.max_watchers)
    return wanted if files == resource.RLIM_INFINITY else min(wanted, max(files // 2, 1))


def _listen(address: str) -> socket.socket:
    host, port = split_address(address)
    family, kind, protocol, _, socket_address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    listener = socket.socket(family, kind, protocol)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(socket_address)
        listener.listen(_BACKLOG)
        listener.setblocking(False)
    except OSError:
        listener.close()
        raise
    return listener
