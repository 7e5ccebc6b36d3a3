"""Bounded intake of gRPC requests.

gRPC would read the request of a unary call before it calls the handler. On the wire a unary request is a
stream of one message, so the interceptor below registers each method as a stream and reads that message
itself, once the call has been accepted, and within limits of time and bytes.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from typing import Any

import grpc
from grpc import aio

from service.errors import BadField, RequestTimeout, ServiceError
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.transports.grpc.status import abort
from service.transports.intake import Body, Intake

RECEIVE_MARGIN = 2
"""Factor on the request limit up to which messages are received, so that they are refused with error
details. Beyond it gRPC itself refuses, with the same code but without details."""
SLOW_SECONDS = 1.0
"""Seconds after which a request that has not arrived counts as one of the largest size, because gRPC does not
tell how much of it has been received."""
_CONTRACT = "/cab."

_Handler = grpc.RpcMethodHandler
_Context = Any  # generic in the message types


class IntakeInterceptor(aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in the stubs only
    """Interceptor that reads requests within the bounds of the intake.

    Calls of the contract count against the bound of calls, except streams; health and reflection do not.
    """

    def __init__(self, intake: Intake, metrics: Metrics, settings: Settings) -> None:
        self._intake = intake
        self._metrics = metrics
        self._timeout = settings.body_timeout
        # A budget of less than one such message must not refuse every slow client.
        self._slow_bytes = min(settings.max_request_bytes * RECEIVE_MARGIN, settings.max_large_intake_bytes)

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable["_Handler[Any, Any]"]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> "_Handler[Any, Any]":
        """Return a handler that reads the request and calls the method's handler with it."""
        handler = await continuation(handler_call_details)
        if handler is None or handler.request_streaming:
            return handler
        method = handler_call_details.method
        counted = method.startswith(_CONTRACT) and not handler.response_streaming
        behavior: Any = handler.unary_stream if handler.response_streaming else handler.unary_unary

        async def handle(_: object, context: _Context) -> Any:
            return await behavior(await self._accept(method, counted, context), context)

        make: Any = (
            grpc.stream_stream_rpc_method_handler
            if handler.response_streaming
            else grpc.stream_unary_rpc_method_handler
        )
        wrapped: _Handler[Any, Any] = make(handle, handler.request_deserializer, handler.response_serializer)
        return wrapped

    async def _accept(self, method: str, counted: bool, context: _Context) -> Any:
        """Return the request of a call that is accepted; end the others with an error."""
        stack = ExitStack()
        # The call counts until its response has been sent, not only until the handler returns.
        context.add_done_callback(lambda _: stack.close())
        try:
            if counted:
                stack.enter_context(self._intake.call())
            body = stack.enter_context(self._intake.body())
            return await self._receive(context, body)
        except ServiceError as error:
            name = method.rpartition("/")[2] if method.startswith(_CONTRACT) else "other"
            with self._metrics.call("grpc", name) as call:
                call.code = error.code
                await abort(context, error)
            raise  # unreachable: abort raises

    async def _receive(self, context: _Context, body: Body) -> Any:
        """Return the request.

        Raises:
            Overloaded: the budget of bytes is used up.
            RequestTimeout: the request did not arrive in time.
            BadField: the client sent none.
        """
        loop = asyncio.get_running_loop()
        refusal: ServiceError = RequestTimeout(f"the request did not arrive within {self._timeout:g} s")

        def count_as_largest() -> None:
            nonlocal refusal
            try:
                body.grow(self._slow_bytes)
            except ServiceError as error:
                refusal = error
                limit.reschedule(loop.time())

        limit = asyncio.timeout(self._timeout)
        slow = loop.call_later(SLOW_SECONDS, count_as_largest)
        try:
            async with limit:
                request = await context.read()
        except TimeoutError as error:
            raise refusal from error
        finally:
            slow.cancel()
        if request is aio.EOF:  # type: ignore[attr-defined]  # the stubs lack it
            raise BadField("body", "is missing")
        if isinstance(request, bytes):  # the contract's methods, which parse their requests themselves
            body.resize(len(request))
        else:
            body.resize(0)
        return request
