"""Bounded intake of gRPC requests.

gRPC would read the request of a unary call before it calls the handler. On the wire a unary request is a
stream of one message, so the interceptor below registers each method as a stream. The handlers of the
contract's methods get an ``Incoming`` in place of the request, and read it within limits of time and bytes
once they have accepted the call; a refused call costs no more than its headers. All other methods get their
requests as usual.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import AbstractContextManager, ExitStack
from typing import Any, TypeVar

import grpc
from grpc import aio

from service.access.caller import Caller, Grant
from service.errors import BadField, RequestTimeout, ServiceError
from service.settings import Settings
from service.transports.calls import CallRecords
from service.transports.grpc.gate import CONTRACT
from service.transports.grpc.status import abort
from service.transports.intake import Intake

RECEIVE_MARGIN = 2
"""Factor on the request limit up to which messages are received, so that they are refused with error
details. Beyond it gRPC itself refuses, with the same code but without details."""
SLOW_SECONDS = 1.0
"""Seconds after which a request that has not arrived counts as one of the largest size, because gRPC does not
tell how much of it has been received."""

_Handler = grpc.RpcMethodHandler
_Context = Any  # generic in the message types
_T = TypeVar("_T")


class Incoming:
    """Request of a call of the contract that has not been read yet."""

    def __init__(self, intake: Intake, settings: Settings, context: _Context) -> None:
        self._intake = intake
        self._context = context
        self._timeout = settings.body_timeout
        # A budget of less than one such message must not refuse every slow client.
        self._slow_bytes = min(settings.max_request_bytes * RECEIVE_MARGIN, settings.max_large_intake_bytes)
        self._write_timeout = settings.write_timeout
        self._unread: asyncio.TimerHandle | None = None
        self._stack = ExitStack()
        # The call counts until its response has been sent, not only until the handler returns.
        context.add_done_callback(lambda _: self._end())

    def hold(self, counted: AbstractContextManager[_T]) -> _T:
        """Enter a context that ends when the response has been sent."""
        return self._stack.enter_context(counted)

    def accept(self, caller: Caller) -> Grant:
        """Count the call against the limits of its caller, then against the bound of all calls.

        Raises:
            LimitExceeded: the caller's key has reached a limit.
            Overloaded: there are too many calls.
        """
        grant = self.hold(caller.call())
        self.hold(self._intake.call())
        return grant

    def send_in_time(self) -> None:
        """Let the call count no longer than the write timeout from now on: its response is being sent.

        gRPC itself ends it only when the client has read the response, is gone, or its deadline has passed.
        """
        self._unread = asyncio.get_running_loop().call_later(self._write_timeout, self._stack.close)

    def _end(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
        self._stack.close()

    async def read(self) -> bytes:
        """Return the request.

        Raises:
            Overloaded: the budget of bytes is used up.
            RequestTimeout: the request did not arrive in time.
            BadField: the client sent none.
        """
        body = self.hold(self._intake.body())
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
                request = await self._context.read()
        except TimeoutError as error:
            raise refusal from error
        finally:
            slow.cancel()
        if request is aio.EOF:  # type: ignore[attr-defined]  # the stubs lack it
            raise BadField("body", "is missing")
        # The contract's methods parse their requests themselves; those of others are small
        received: bytes = request
        body.resize(len(received) if isinstance(received, bytes) else 0)
        return received


class IntakeInterceptor(aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in the stubs only
    """Interceptor that lets handlers accept a call before its request is read."""

    def __init__(self, intake: Intake, records: CallRecords, settings: Settings) -> None:
        self._intake = intake
        self._records = records
        self._settings = settings

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable["_Handler[Any, Any]"]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> "_Handler[Any, Any]":
        """Return a handler of a stream that calls the method's handler."""
        handler = await continuation(handler_call_details)
        if handler is None or handler.request_streaming:
            return handler
        in_contract = handler_call_details.method.startswith(CONTRACT)
        behavior: Any = handler.unary_stream if handler.response_streaming else handler.unary_unary

        async def handle(_: object, context: _Context) -> Any:
            incoming = Incoming(self._intake, self._settings, context)
            response = await behavior(
                incoming if in_contract else await self._read(incoming, context), context
            )
            incoming.send_in_time()
            return response

        make: Any = (
            grpc.stream_stream_rpc_method_handler
            if handler.response_streaming
            else grpc.stream_unary_rpc_method_handler
        )
        wrapped: _Handler[Any, Any] = make(handle, handler.request_deserializer, handler.response_serializer)
        return wrapped

    async def _read(self, incoming: Incoming, context: _Context) -> Any:
        """Return the request of a method outside the contract."""
        try:
            return await incoming.read()
        except ServiceError as error:
            with self._records.record("other") as recorder:
                await abort(context, recorder.failed(error))
            raise  # unreachable: abort raises
