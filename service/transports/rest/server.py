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
from starlette.applications import Starlette
from starlette.convertors import PathConvertor, register_url_convertor
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp

from service.access.gate import Gate
from service.access.tls import Certificates
from service.access.watched import Watched
from service.errors import BadField, MethodNotAllowed, NotFound, ServiceError, Unavailable
from service.predict.dataplane import DataPlane
from service.settings import Settings, split_address
from service.telemetry.metrics import Metrics
from service.telemetry.request_ids import HEADER, TRACEPARENT, TRACESTATE
from service.telemetry.tracing import Tracing
from service.transports.calls import CallRecords, to_service_error
from service.transports.intake import Intake
from service.transports.rest.connections import BoundedProtocol, Connections
from service.transports.rest.console import add_root
from service.transports.rest.endpoints import Endpoints, ExitStackMiddleware
from service.transports.rest.gate import LIVE_PATH, METRICS_PATH, READY_PATH, GateMiddleware
from service.transports.rest.handshake import Handshake
from service.transports.rest.negotiation import TIMEOUT_HEADER
from service.transports.rest.openapi import openapi_document
from service.transports.rest.problem import problem_response
from service.transports.rest.request_ids import RequestIdMiddleware

_POLL = 0.005
"""Seconds between looks at uvicorn's started flag."""
_MIN_GRACE = 0.1
"""Seconds. With a grace period of 0 uvicorn would skip the wait for open connections entirely."""
_BACKLOG = 2048


class _IdConvertor(PathConvertor):
    """Text of any kind: ids may hold slashes, and line breaks, which Starlette's convertors do not match."""

    regex = r"[\s\S]*"


register_url_convertor("id", _IdConvertor())


def build_app(
    dataplane: DataPlane,
    metrics: Metrics,
    settings: Settings,
    intake: Intake,
    gate: Gate,
    tracing: Tracing | None = None,
) -> FastAPI:
    """Build the application: the contract's routes, probes, metrics and documentation.

    Args:
        dataplane: executes the calls.
        metrics: counts the calls, and is served at ``/metrics``.
        settings: limits.
        intake: bounds the calls and their bodies.
        gate: authenticates the callers.
        tracing: traces the calls; None: they are not traced.
    """
    document = openapi_document(settings, closed=gate.closed)
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
    app.add_middleware(GateMiddleware, gate=gate)
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["GET", "POST"],
            allow_headers=["Authorization", TIMEOUT_HEADER, HEADER, TRACEPARENT, TRACESTATE],
            expose_headers=["Retry-After", HEADER],
        )
    records = CallRecords("rest", metrics, settings, tracing)
    for route, endpoint in Endpoints(dataplane, records, settings, intake, gate).by_route().items():
        path = route.path.replace("{scene_id}", "{scene_id:id}")
        app.add_route(path, endpoint, methods=[route.verb])

    async def show_metrics(request: Request) -> Response:
        if tracing is not None:  # only OpenMetrics has exemplars
            body, media_type = metrics.render_for(request.headers.get("accept", ""))
            return Response(body, headers={"content-type": media_type})
        return Response(metrics.render(), media_type=prometheus_client.CONTENT_TYPE_LATEST)

    app.add_route(METRICS_PATH, show_metrics, methods=["GET"])
    _add_probes(app, dataplane)
    add_root(app, settings, closed=gate.closed)
    return app


def build_probes(dataplane: DataPlane) -> Starlette:
    """Build the application of the port for probes alone.

    Args:
        dataplane: knows whether it is ready.
    """
    app = Starlette(exception_handlers={HTTPException: _on_http_error})
    _add_probes(app, dataplane)
    return app


def _add_probes(app: Starlette, dataplane: DataPlane) -> None:
    async def livez(_: Request) -> Response:
        return PlainTextResponse("alive\n")

    async def readyz(_: Request) -> Response:
        try:
            dataplane.require_ready()
        except Unavailable as error:
            return problem_response(error)
        return PlainTextResponse("ready\n")

    app.add_route(LIVE_PATH, livez, methods=["GET"])
    app.add_route(READY_PATH, readyz, methods=["GET"])


class HttpServer:
    """uvicorn on a socket that this class opens; stopped by ``stop``, not by signals."""

    def __init__(
        self,
        app: ASGIApp,
        address: str,
        settings: Settings,
        certificates: Watched[Certificates] | None = None,
    ) -> None:
        """
        Args:
            app: the application.
            address: HOST:PORT to listen on; port 0: any free port.
            settings: limits of the connections.
            certificates: certificates for TLS; None: plain HTTP.
        """
        self._configured_address = address
        self._limits = Connections(
            _max_connections(settings),
            settings.header_timeout,
            settings.body_timeout,
            settings.max_connection_age,
            settings.write_timeout,
        )
        protocol: Any = (
            functools.partial(BoundedProtocol, self._limits)
            if certificates is None
            else functools.partial(Handshake, self._limits, certificates)
        )
        self._server = _Uvicorn(
            uvicorn.Config(
                RequestIdMiddleware(app),
                log_config=None,
                access_log=False,
                lifespan="off",
                ws="none",
                http=protocol,
                server_header=False,
                timeout_keep_alive=settings.idle_timeout,  # type: ignore[arg-type]  # fractions work
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
        for handshake in list(self._limits.handshakes):
            handshake.transport.abort()
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
