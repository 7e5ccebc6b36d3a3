"""Request ids over gRPC: in the metadata of requests and in the trailing metadata of responses."""

from collections.abc import Awaitable, Callable
from typing import Any

import grpc
from grpc import aio

from service.telemetry.request_ids import HEADER, TRACEPARENT, TRACESTATE, begin, ids_of


class RequestIdInterceptor(aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in the stubs only
    """Interceptor that gives each call its ids; it comes first, so that refusals have them as well."""

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable["grpc.RpcMethodHandler[Any, Any]"]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> "grpc.RpcMethodHandler[Any, Any]":
        """Return the method's handler; gRPC runs it in the same task."""
        metadata = dict(handler_call_details.invocation_metadata)
        begin(ids_of(*(_text(metadata.get(name)) for name in (HEADER, TRACEPARENT, TRACESTATE))))
        return await continuation(handler_call_details)


def _text(value: str | bytes | None) -> str | None:
    return value if isinstance(value, str) else None
