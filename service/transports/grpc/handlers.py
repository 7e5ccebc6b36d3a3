"""gRPC handlers of the contract's methods.

The handlers read and return bytes. A request that is too large or malformed therefore fails like any other
bad request, with error details, and not without details inside gRPC. Predict and Explain read their requests
after the call has been accepted.

gRPC cancels a handler when the client disconnects or its deadline passes, which removes the call from any
queue that it waits in.
"""

import asyncio
import functools
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import aclosing, asynccontextmanager
from typing import Any

import grpc
from google.protobuf.message import Message
from grpc import aio

from cab.forecast.v1.explanation_service_pb2 import ExplainRequest
from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab.forecast.v1.routes import EXPLAIN, PREDICT, SERVICES, Request, Response, Route
from service.access.caller import Grant
from service.errors import TooLarge
from service.predict.dataplane import DataPlane
from service.predict.request_reader import LARGE_BYTES, EncodedRequest, RequestLimits, read_protobuf
from service.scenes.shared_message import to_protobuf
from service.settings import Settings
from service.telemetry.request_ids import HEADER, current_request_id
from service.transports.calls import STREAMS, UNARY_METHODS, CallRecords, parse_message
from service.transports.grpc.gate import current_caller
from service.transports.grpc.intake import Incoming
from service.transports.grpc.status import abort
from service.transports.streams import HEARTBEAT, Event, encoded, with_idle_ticks

Context = Any  # grpc.aio.ServicerContext is generic in the message types, which are bytes here


class Handlers:
    """The contract's methods as gRPC handlers."""

    def __init__(self, dataplane: DataPlane, records: CallRecords, settings: Settings) -> None:
        self._dataplane = dataplane
        self._records = records
        self._max_bytes = settings.max_request_bytes
        self._limits = RequestLimits.from_settings(settings)

    def generic(self) -> "list[grpc.GenericRpcHandler[bytes, bytes]]":
        """Return handlers for ``server.add_generic_rpc_handlers``, one per service."""
        handlers: dict[Route[Any, Any], grpc.RpcMethodHandler[bytes, bytes]] = {
            PREDICT: self._bytes(PREDICT, self._predict),
            EXPLAIN: self._bytes(EXPLAIN, self._explain),
        }
        for route, watch in STREAMS.items():
            handlers[route] = self._stream(route, functools.partial(watch, self._dataplane))
        for route, execute in UNARY_METHODS.items():
            handlers[route] = self._unary(route, functools.partial(execute, self._dataplane))
        return [
            grpc.method_handlers_generic_handler(
                service,
                {route.method: handler for route, handler in handlers.items() if route.service == service},
            )
            for service in SERVICES
        ]

    async def _predict(self, incoming: Incoming, grant: Grant, context: Context) -> Message:
        # The call counts as in progress until the response was sent, not only until this returns.
        call = incoming.hold(self._dataplane.accept(context.time_remaining(), grant))
        read = functools.partial(read_protobuf, PredictRequest, limits=self._limits)
        encoded = EncodedRequest(await self._read(incoming), read, LARGE_BYTES)
        return await self._dataplane.predict(encoded, call)

    async def _explain(self, incoming: Incoming, grant: Grant, context: Context) -> Message:
        call = incoming.hold(self._dataplane.accept_explanation(context.time_remaining(), grant))
        read = functools.partial(read_protobuf, ExplainRequest, limits=self._limits)
        encoded = EncodedRequest(await self._read(incoming), read, LARGE_BYTES)
        return await self._dataplane.explain(encoded, call)

    def _bytes(
        self, route: Route[Any, Any], behavior: Callable[[Incoming, Grant, Context], Awaitable[Message]]
    ) -> "grpc.RpcMethodHandler[bytes, bytes]":
        """Return the handler of a method that reads and parses its request itself."""

        async def handle(incoming: Incoming, context: Context) -> bytes:
            async with self._recorded(route, context):
                grant = incoming.accept(current_caller())
                return (await behavior(incoming, grant, context)).SerializeToString()

        return _handler(grpc.unary_unary_rpc_method_handler, handle)

    def _unary(
        self, route: Route[Request, Response], behavior: Callable[[Request, str | None], Awaitable[Message]]
    ) -> "grpc.RpcMethodHandler[bytes, bytes]":
        """Return the handler of a method with small requests."""

        async def parse_and_execute(incoming: Incoming, grant: Grant, _: Context) -> Message:
            return await behavior(parse_message(route.request, await self._read(incoming)), grant.caller.name)

        return self._bytes(route, parse_and_execute)

    def _stream(
        self, route: Route[Request, Response], behavior: Callable[[Request], AsyncIterator[Event]]
    ) -> "grpc.RpcMethodHandler[bytes, bytes]":
        """Return the handler of a method that responds with a stream."""

        async def handle(incoming: Incoming, context: Context) -> None:
            async with self._recorded(route, context):
                events = behavior(parse_message(route.request, await self._read(incoming)))
                ticking = with_idle_ticks(events, HEARTBEAT)
                async with current_caller().stream(), aclosing(ticking):
                    async for event in ticking:
                        await _send(context, route.response() if event is None else event)

        return _handler(grpc.unary_stream_rpc_method_handler, handle)

    async def _read(self, incoming: Incoming) -> bytes:
        """Return the body of a request; refuse one that is too large."""
        body = await incoming.read()
        if len(body) > self._max_bytes:
            raise TooLarge(f"the request has {len(body)} bytes; at most {self._max_bytes} are accepted")
        return body

    @asynccontextmanager
    async def _recorded(self, route: Route[Any, Any], context: Context) -> AsyncIterator[None]:
        """Record a call, and turn exceptions into a status with details."""
        context.set_trailing_metadata(((HEADER, current_request_id()),))
        with self._records.record(route.method, timed=not route.streaming) as recorder:
            recorder.identified(current_caller())
            try:
                yield
            except Exception as exception:
                await abort(context, recorder.failed(exception))
                raise  # unreachable: abort raises
            recorder.succeeded()


def _handler(make: Any, handle: Callable[[Incoming, Context], Any]) -> "grpc.RpcMethodHandler[bytes, bytes]":
    """Return a handler of bytes; the interceptor of the intake calls it with the incoming request instead."""
    handler: grpc.RpcMethodHandler[bytes, bytes] = make(handle)
    return handler


async def _send(context: Context, event: Event) -> None:
    """Send one message of a stream.

    Raises:
        CancelledError: the client disconnected; gRPC notices this in a write before it cancels the call.
    """
    try:
        await context.write(await encoded(event, to_protobuf))
    except aio.InternalError as error:
        raise asyncio.CancelledError from error
