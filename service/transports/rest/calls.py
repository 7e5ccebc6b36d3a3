"""What all REST calls have in common: they are counted, bounded, and their errors become problems here."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import structlog
from google.protobuf.message import Message
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import Receive

from service.errors import ServiceError, TooLarge
from service.settings import Settings
from service.telemetry.metrics import Call, Metrics
from service.transports.auth import Tokens
from service.transports.boundary import to_service_error
from service.transports.rest.codec import to_json
from service.transports.rest.negotiation import Format
from service.transports.rest.problem import problem_response

_log = structlog.get_logger(__name__)
_T = TypeVar("_T")
_CLIENT_CLOSED_REQUEST = 499
"""What is logged, though nobody is there to read it."""


class Counted:
    """A call that is under way."""

    def __init__(self, method: str, call: Call) -> None:
        self._method = method
        self._call = call

    def failed(self, exception: Exception) -> ServiceError:
        """Notes how the call failed, and gives the table's row for it."""
        error = to_service_error(exception, self._method)
        self._call.code = error.code
        _log.debug("call", transport="rest", method=self._method, code=error.code, reason=error.reason)
        return error

    def ended(self) -> None:
        """Notes that the call had its answer."""
        self._call.code = "OK"
        _log.debug("call", transport="rest", method=self._method, code="OK")

    def left(self) -> None:
        """Notes that the client went away first; the code says so already."""
        _log.debug("call", transport="rest", method=self._method, code=self._call.code)


class Calls:
    """Carries calls from request to response."""

    def __init__(self, metrics: Metrics, settings: Settings) -> None:
        self._metrics = metrics
        self._tokens = Tokens(settings.api_tokens)
        self._max_bytes = settings.max_request_bytes

    @contextmanager
    def counted(self, method: str, timed: bool = True) -> Iterator[Counted]:
        """Counts a call until this is left, and times it unless it lasts as long as the client likes."""
        with self._metrics.call("rest", method, timed) as call:
            yield Counted(method, call)

    def authorize(self, request: Request) -> None:
        """Lets a call in.

        Raises:
            Unauthenticated: it may not.
        """
        self._tokens.check(request.headers.get("authorization"))

    async def answer(
        self, method: str, request: Request, behavior: Callable[[Request], Awaitable[Response]]
    ) -> Response:
        """The response to a call.

        Args:
            method: of the contract.
            request: as it came.
            behavior: what answers.
        """
        with self.counted(method) as call:
            try:
                self.authorize(request)
                response = await behavior(request)
            except ClientDisconnect:
                call.left()
                return Response(status_code=_CLIENT_CLOSED_REQUEST)
            except Exception as exception:
                return problem_response(call.failed(exception))
            call.ended()
            return response

    async def read_body(self, request: Request, at_most: int | None = None) -> bytes:
        """The body, refused as soon as it is known to be too large, however it is sent.

        Args:
            request: as it came.
            at_most: bytes; the server's own limit holds as well.

        Raises:
            TooLarge: it has more.
        """
        limit = self._max_bytes if at_most is None else min(at_most, self._max_bytes)
        too_large = TooLarge(f"the body has more than {limit} bytes")
        declared = request.headers.get("content-length", "")
        if declared.isdecimal() and int(declared) > limit:
            raise too_large
        body = bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > limit:
                raise too_large
        return bytes(body)


def respond(message: Message, outgoing: Format) -> Response:
    """A message as a response."""
    body = to_json(message) if outgoing is Format.JSON else message.SerializeToString()
    return Response(body, media_type=outgoing.value)


async def unless_disconnected(receive: Receive, work: Awaitable[_T]) -> _T:
    """What the work gives; it is cancelled when the client goes away first.

    Args:
        receive: of the request, the body of which was read before.
        work: what the client waits for.

    Raises:
        ClientDisconnect: it did.
    """
    task = asyncio.ensure_future(work)
    watch = asyncio.create_task(_disconnected(receive))
    try:
        await asyncio.wait({task, watch}, return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise ClientDisconnect
        return task.result()
    finally:
        task.cancel()
        watch.cancel()
        await asyncio.gather(task, watch, return_exceptions=True)


async def _disconnected(receive: Receive) -> None:
    """Returns when the client has gone away."""
    while (await receive())["type"] != "http.disconnect":
        pass
