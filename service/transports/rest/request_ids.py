"""Request ids over REST: in a header of requests and responses."""

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.telemetry.request_ids import HEADER, TRACEPARENT, TRACESTATE, begin, ids_of


class RequestIdMiddleware:
    """Middleware that gives each request its ids; it comes first, so that refusals have them as well."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        headers = Headers(scope=scope)
        ids = ids_of(headers.get(HEADER), headers.get(TRACEPARENT), headers.get(TRACESTATE))
        begin(ids)

        async def send_with_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[HEADER] = ids.request_id
            await send(message)

        await self._app(scope, receive, send_with_id)
