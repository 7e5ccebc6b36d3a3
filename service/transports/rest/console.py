"""The root of REST: the live console for browsers, and a directory of the API for programs."""

from importlib import metadata, resources
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cab.forecast.v1.routes import ROUTES
from service.settings import Settings, is_local
from service.transports.rest.negotiation import prefers_html

ROOT_PATH = "/"
CONSOLE_PATH = "/console/"
"""Beginning of the paths of the console's files. They are the same for everyone and hold no data, so they
need no key: the page asks for one and sends it with its calls."""

_PAGE = "index.html"
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-cache",  # a new server may bring other files: browsers ask by ETag
}


def add_root(app: Starlette, settings: Settings, *, closed: bool) -> None:
    """Add the root and, if it is on, the console.

    Args:
        app: the application.
        settings: say whether the console is on.
        closed: True if callers need a key.
    """
    directory = _directory()
    shown = console_is_on(settings, closed=closed)
    folder = Path(str(resources.files("service") / "console"))

    async def root(request: Request) -> Response:
        if shown and prefers_html(request.headers):
            return FileResponse(folder / _PAGE, headers=_HEADERS | {"Vary": "Accept"})
        return JSONResponse(directory, headers={"Vary": "Accept"})

    app.add_route(ROOT_PATH, root, methods=["GET"])
    if shown:
        app.mount(CONSOLE_PATH, _WithHeaders(StaticFiles(directory=folder)), name="console")


def console_is_on(settings: Settings, *, closed: bool) -> bool:
    """Return whether the console is served: as the setting says, else where not just anyone can call.

    Args:
        settings: the settings.
        closed: True if callers need a key.
    """
    return (closed or is_local(settings)) if settings.console is None else settings.console


def _directory() -> dict[str, Any]:
    """Return what programs get at the root: where to find what."""
    return {
        "name": "cab-forecast",
        "version": metadata.version("cab-forecast"),
        "documentation": "/docs",
        "openapi": "/openapi.json",
        "live": "/livez",
        "ready": "/readyz",
        "metrics": "/metrics",
        "methods": {route.method: f"{route.verb} {route.path}" for route in ROUTES},
    }


class _WithHeaders:
    """Middleware that adds the console's headers to every response."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = Headers(raw=message["headers"])
                added = [
                    (name.lower().encode(), value.encode())
                    for name, value in _HEADERS.items()
                    if name not in given
                ]
                message["headers"] = [*message["headers"], *added]
            await send(message)

        await self._app(scope, receive, send_with_headers)
