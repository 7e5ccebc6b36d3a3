"""Access to what REST serves beside the contract: metrics and documentation need a key; probes and the files
of the console do not."""

from contextlib import ExitStack

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.access.gate import Gate
from service.access.scopes import Scope as KeyScope
from service.errors import ServiceError, Unauthenticated
from service.transports.rest.console import CONSOLE_PATH, ROOT_PATH
from service.transports.rest.problem import problem_response

LIVE_PATH = "/livez"
READY_PATH = "/readyz"
METRICS_PATH = "/metrics"
_OPEN = frozenset((LIVE_PATH, READY_PATH, ROOT_PATH))
"""Paths for everyone: orchestrators probe without credentials, and the root says where to find what."""
_OPEN_FOLDERS = ("/v1/", CONSOLE_PATH)
"""Beginnings of the contract's paths, whose endpoints authenticate by themselves and record the call, and of
the console's files."""
_CHALLENGE = {"WWW-Authenticate": 'Basic realm="cab-forecast", charset="UTF-8", Bearer'}
"""Challenge for pages that people open in a browser, which then asks for the key as a password."""


class GateMiddleware:
    """Middleware that lets in callers with a key only, to all paths but the contract's and the probes."""

    def __init__(self, app: ASGIApp, gate: Gate) -> None:
        self._app = app
        self._gate = gate

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        path: str = scope["path"]
        if path in _OPEN or path.startswith(_OPEN_FOLDERS):
            await self._app(scope, receive, send)
            return
        with ExitStack() as stack:
            try:
                caller = self._gate.identify(Headers(scope=scope).get("authorization"), basic=True)
                caller.require(KeyScope.METRICS if path == METRICS_PATH else None)
                stack.enter_context(caller.call())
            except ServiceError as error:
                headers = _CHALLENGE if isinstance(error, Unauthenticated) else None
                await problem_response(error, headers)(scope, receive, send)
                return
            await self._app(scope, receive, send)
