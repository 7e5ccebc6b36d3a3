"""Access to gRPC: callers are authenticated, and need the scope of the method."""

from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from typing import Any

import grpc
from grpc import aio

from cab.forecast.v1.routes import ROUTES
from service.access.caller import Caller
from service.access.gate import Gate
from service.access.scopes import Scope, scope_of
from service.errors import ServiceError
from service.transports.calls import CallRecords
from service.transports.grpc.status import abort

CONTRACT = "/cab."
"""Beginning of the names of the contract's methods."""
_OPEN = ("/grpc.health.v1.Health/",)
"""Methods that need no credentials, because orchestrators probe without."""
_SCOPES = {route.rpc: scope_of(route) for route in ROUTES}
"""Scope of each method of the contract."""

_CALLER: ContextVar[Caller] = ContextVar("caller")


def current_caller() -> Caller:
    """Return the caller of the call that this task handles."""
    return _CALLER.get()


class GateInterceptor(aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in the stubs only
    """Interceptor that refuses calls without a valid key, or with one that lacks the scope."""

    def __init__(self, gate: Gate, records: CallRecords) -> None:
        self._gate = gate
        self._records = records

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable["grpc.RpcMethodHandler[Any, Any]"]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> "grpc.RpcMethodHandler[Any, Any]":
        """Return the method's handler, or one that refuses the call."""
        method = handler_call_details.method
        if method.startswith(_OPEN):
            return await continuation(handler_call_details)
        metadata = dict(handler_call_details.invocation_metadata)
        header = metadata.get("authorization")
        caller = None
        try:
            caller = self._gate.identify(header if isinstance(header, str) else None)
            caller.require(_scope(method))
        except ServiceError as error:
            handler = await continuation(handler_call_details)
            return handler if handler is None else self._refusal(handler, error, method, caller)
        _CALLER.set(caller)  # gRPC runs interceptors and handler of a call in one task
        return await continuation(handler_call_details)

    def _refusal(
        self,
        handler: "grpc.RpcMethodHandler[Any, Any]",
        error: ServiceError,
        method: str,
        caller: Caller | None,
    ) -> "grpc.RpcMethodHandler[Any, Any]":
        name = method.rpartition("/")[2] if method.startswith(CONTRACT) else "other"

        async def refuse(_: object, context: Any) -> None:
            with self._records.record(name) as recorder:
                if caller is not None:
                    recorder.identified(caller)
                await abort(context, recorder.failed(error))

        # The refusal must have the arity of the method that it replaces: some of them stream.
        if handler.request_streaming:
            return grpc.stream_stream_rpc_method_handler(refuse)
        if handler.response_streaming:
            return grpc.unary_stream_rpc_method_handler(refuse)
        return grpc.unary_unary_rpc_method_handler(refuse)


def _scope(method: str) -> Scope | None:
    """Return the scope that a method needs; reflection needs a key, of any scope."""
    return _SCOPES.get(method, Scope.ADMIN) if method.startswith(CONTRACT) else None
