"""Credentials of gRPC calls."""

from collections.abc import Awaitable, Callable
from typing import Any

import grpc

from service.errors import Unauthenticated
from service.telemetry.metrics import Metrics
from service.transports.auth import Tokens
from service.transports.grpc.status import abort

_OPEN = ("/grpc.health.v1.Health/",)
"""What orchestrators probe without credentials."""


class AuthInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in the stubs only
    """Lets calls with a known bearer token through."""

    def __init__(self, tokens: Tokens, metrics: Metrics) -> None:
        self._tokens = tokens
        self._metrics = metrics

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable["grpc.RpcMethodHandler[Any, Any]"]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> "grpc.RpcMethodHandler[Any, Any]":
        """The method's handler, or one that refuses."""
        method = handler_call_details.method
        if method.startswith(_OPEN):
            return await continuation(handler_call_details)
        metadata = dict(handler_call_details.invocation_metadata)
        header = metadata.get("authorization")
        try:
            self._tokens.check(header if isinstance(header, str) else None)
        except Unauthenticated as error:
            handler = await continuation(handler_call_details)
            return handler if handler is None else self._refusal(handler, error, method)
        return await continuation(handler_call_details)

    def _refusal(
        self, handler: "grpc.RpcMethodHandler[Any, Any]", error: Unauthenticated, method: str
    ) -> "grpc.RpcMethodHandler[Any, Any]":
        name = method.rpartition("/")[2] if method.startswith("/cab.") else "other"

        async def refuse(_: object, context: Any) -> None:
            with self._metrics.call("grpc", name) as call:
                call.code = error.code
                await abort(context, error)

        # The refusal must be of the same arity as what it stands for: watches and reflection are streams.
        if handler.request_streaming:
            return grpc.stream_stream_rpc_method_handler(refuse)
        if handler.response_streaming:
            return grpc.unary_stream_rpc_method_handler(refuse)
        return grpc.unary_unary_rpc_method_handler(refuse)
