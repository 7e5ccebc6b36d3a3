"""What is held for a call until its answer is out."""

from contextlib import ExitStack

from starlette.requests import Request
from starlette.types import ASGIApp, Receive, Scope, Send

_KEY = "forecast.held"


class HoldUntilSent:
    """Middleware: a handler returns before its response is sent, and what it must not let go of until
    then it leaves here."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serves one request."""
        with ExitStack() as stack:
            scope[_KEY] = stack
            await self._app(scope, receive, send)


def held(request: Request) -> ExitStack:
    """What is let go of once the response to a request was sent."""
    stack: ExitStack = request.scope[_KEY]
    return stack
