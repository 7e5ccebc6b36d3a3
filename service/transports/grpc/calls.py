"""What all gRPC calls have in common: they are counted, bounded, and their errors become statuses here."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, TypeVar

import grpc
import structlog
from google.protobuf.message import Message
from grpc import aio

from service.errors import TooLarge
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.transports.boundary import to_service_error
from service.transports.grpc.status import abort
from service.transports.messages import parse_message
from service.transports.watching import closing

_log = structlog.get_logger(__name__)
_Request = TypeVar("_Request", bound=Message)
Context = Any  # grpc.aio.ServicerContext is generic in messages that are bytes here


class Calls:
    """Makes handlers that take and give bytes: a message that is too large or no message at all then fails
    like any other bad call, with details, instead of somewhere inside gRPC without.

    gRPC cancels a handler when the client goes away or its deadline passes, and with it whatever the call has
    in a queue or reads from.
    """

    def __init__(self, metrics: Metrics, settings: Settings) -> None:
        self._metrics = metrics
        self._max_bytes = settings.max_request_bytes

    def raw(
        self, method: str, behavior: Callable[[bytes, Context], Awaitable[Message]]
    ) -> "grpc.RpcMethodHandler[bytes, bytes]":
        """A method that reads its request itself."""

        async def handle(body: bytes, context: Context) -> bytes:
            async with self._counted(method, body, context):
                return (await behavior(body, context)).SerializeToString()

        return grpc.unary_unary_rpc_method_handler(handle)

    def unary(
        self, method: str, request_type: type[_Request], behavior: Callable[[_Request], Awaitable[Message]]
    ) -> "grpc.RpcMethodHandler[bytes, bytes]":
        """A method of small requests."""

        async def read_and_answer(body: bytes, _: Context) -> Message:
            return await behavior(parse_message(request_type, body))

        return self.raw(method, read_and_answer)

    def stream(
        self,
        method: str,
        request_type: type[_Request],
        behavior: Callable[[_Request], AsyncIterator[Message]],
    ) -> "grpc.RpcMethodHandler[bytes, bytes]":
        """A method that answers with messages for as long as there are any."""

        async def handle(body: bytes, context: Context) -> None:
            async with self._counted(method, body, context, timed=False):
                events = behavior(parse_message(request_type, body))
                async with closing(events):
                    async for event in events:
                        await _send(context, event)

        return grpc.unary_stream_rpc_method_handler(handle)

    @asynccontextmanager
    async def _counted(
        self, method: str, body: bytes, context: Context, timed: bool = True
    ) -> AsyncIterator[None]:
        with self._metrics.call("grpc", method, timed) as call:
            try:
                if len(body) > self._max_bytes:
                    raise TooLarge(
                        f"the request has {len(body)} bytes; at most {self._max_bytes} are accepted"
                    )
                yield
            except Exception as exception:
                error = to_service_error(exception, method)
                call.code = error.code
                _log.debug("call", transport="grpc", method=method, code=error.code, reason=error.reason)
                await abort(context, error)
                raise  # not reached: abort raises
            call.code = "OK"
            _log.debug("call", transport="grpc", method=method, code="OK")


async def _send(context: Context, message: Message) -> None:
    """Sends a message of a stream.

    Raises:
        CancelledError: the client is gone; gRPC notices that in the midst of a message before it cancels.
    """
    try:
        await context.write(message.SerializeToString())
    except aio.InternalError as error:
        raise asyncio.CancelledError from error
