"""The HTTP application."""

from collections.abc import Awaitable, Callable
from typing import Any

import prometheus_client
from fastapi import FastAPI
from fastapi_offline import FastAPIOffline
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from service.errors import BadField, MethodNotAllowed, NotFound, ServiceError, Unavailable
from service.lifecycle import Phase
from service.predict.pipeline import DataPlane
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.transports.boundary import to_service_error
from service.transports.rest.calls import Calls
from service.transports.rest.consistency import ConsistencyEndpoints
from service.transports.rest.endpoints import Endpoints
from service.transports.rest.openapi import openapi_document
from service.transports.rest.problem import problem_response
from service.transports.rest.sending import HoldUntilSent


def build_app(dataplane: DataPlane, metrics: Metrics, settings: Settings) -> FastAPI:
    """All routes.

    Args:
        dataplane: what answers.
        metrics: what is counted, and shown at ``/metrics``.
        settings: limits and tokens.
    """
    document = openapi_document(settings)
    # Swagger UI from files of our own: the networks that this runs in often reach no CDN
    app = FastAPIOffline(
        title=document["info"]["title"],
        version=document["info"]["version"],
        docs_url="/docs",
        redoc_url=None,
        exception_handlers={HTTPException: _on_http_error, Exception: _on_error},
    )
    app.openapi = lambda: document  # type: ignore[method-assign]  # the way that FastAPI documents

    app.add_middleware(HoldUntilSent)
    calls = Calls(metrics, settings)
    endpoints = Endpoints(dataplane, calls, settings)
    consistency = ConsistencyEndpoints(dataplane, calls)
    routes: list[tuple[str, str, Callable[[Request], Awaitable[Response]]]] = [
        ("POST", "/v1/predict", endpoints.predict),
        ("GET", "/v1/models", endpoints.list_models),
        ("GET", "/v1/models/{name}", endpoints.get_model),
        ("GET", "/v1/consistency/agent", consistency.get_agent),
        ("GET", "/v1/consistency/scene", consistency.get_scene),
        ("GET", "/v1/consistency/models", consistency.list_models),
        ("GET", "/v1/consistency/events", consistency.watch_scene),
        ("POST", "/v1/consistency/reset", consistency.reset_scene),
    ]
    for method, path, endpoint in routes:
        app.add_route(path, endpoint, methods=[method])

    async def livez(_: Request) -> Response:
        return PlainTextResponse("alive\n")

    async def readyz(_: Request) -> Response:
        if dataplane.phase is Phase.READY:
            return PlainTextResponse("ready\n")
        return problem_response(Unavailable(f"the server is {dataplane.phase.value}"))

    async def show_metrics(_: Request) -> Response:
        return Response(metrics.render(), media_type=prometheus_client.CONTENT_TYPE_LATEST)

    app.add_route("/livez", livez, methods=["GET"])
    app.add_route("/readyz", readyz, methods=["GET"])
    app.add_route("/metrics", show_metrics, methods=["GET"])
    return app


async def _on_http_error(request: Request, exception: Any) -> Response:
    """What the framework itself refuses, in the table's words."""
    address = f"{request.method} {request.url.path}"
    error: ServiceError
    if exception.status_code == NotFound.http_status:
        error = NotFound(f"nothing answers {address[:200]}")
    elif exception.status_code == MethodNotAllowed.http_status:
        error = MethodNotAllowed(f"{address[:200]} is not a method of this address")
    else:
        error = BadField("request", str(exception.detail))
    return problem_response(error, exception.headers)


async def _on_error(request: Request, exception: Exception) -> Response:
    return problem_response(to_service_error(exception, request.url.path))
