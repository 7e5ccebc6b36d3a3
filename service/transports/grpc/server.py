"""gRPC server: the contract's services, health and reflection on one port."""

from collections.abc import Awaitable, Callable
from typing import Any

import grpc
from grpc import aio
from grpc_health.v1 import health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from cab.forecast.v1.routes import SERVICES
from service.errors import Unauthenticated
from service.predict.dataplane import DataPlane
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.transports.auth import Tokens
from service.transports.grpc.handlers import Handlers
from service.transports.grpc.health import HEALTH_SERVICE, Health
from service.transports.grpc.intake import RECEIVE_MARGIN, IntakeInterceptor
from service.transports.grpc.status import abort
from service.transports.intake import Intake

_UNLIMITED = -1
_KEEPALIVE = (
    # Detect within about a minute that a client has vanished; its streams would never end otherwise.
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 20_000),
    ("grpc.http2.max_pings_without_data", 0),  # unlimited
    ("grpc.http2.min_ping_interval_without_data_ms", 10_000),  # for clients that send keepalive pings too
)
_OPEN = ("/grpc.health.v1.Health/",)
"""Methods that need no credentials, because orchestrators probe without."""


class GrpcServer:
    """The gRPC server, with the contract's services, health and reflection."""

    def __init__(self, dataplane: DataPlane, metrics: Metrics, settings: Settings, intake: Intake) -> None:
        self._settings = settings
        self._server = aio.server(
            interceptors=[
                AuthInterceptor(Tokens(settings.api_tokens), metrics),
                IntakeInterceptor(intake, metrics, settings),
            ],
            options=[
                ("grpc.max_receive_message_length", settings.max_request_bytes * RECEIVE_MARGIN),
                ("grpc.server_handshake_timeout_ms", max(round(settings.header_timeout * 1000), 1)),
                ("grpc.max_send_message_length", _UNLIMITED),
                ("grpc.so_reuseport", 0),  # otherwise a second server would silently share the port
                *_KEEPALIVE,
            ],
        )
        self._health = Health(SERVICES)
        handlers = Handlers(dataplane, metrics, settings)
        self._server.add_generic_rpc_handlers(tuple(handlers.generic()))
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        names = (*SERVICES, HEALTH_SERVICE, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, self._server)
        self.address = ""
        """HOST:PORT that the server listens on, once started."""

    async def start(self) -> None:
        """Listen and begin to serve.

        Raises:
            OSError: the port is in use, or the host is not an address of this machine.
        """
        host = self._settings.grpc.rpartition(":")[0]
        try:
            port = self._server.add_insecure_port(self._settings.grpc)
        except RuntimeError as error:
            raise OSError(str(error)) from error
        self.address = f"{host}:{port}"
        await self._server.start()

    def set_serving(self, serving: bool) -> None:
        """Set the health of "" and of each service."""
        self._health.set_serving(serving)

    async def stop(self, grace: float) -> None:
        """Stop accepting calls, and cancel those in progress after a grace period.

        Args:
            grace: seconds.
        """
        self._health.close()
        await self._server.stop(grace)


class AuthInterceptor(grpc.aio.ServerInterceptor):  # type: ignore[type-arg]  # generic in the stubs only
    """Interceptor that refuses calls without a valid bearer token."""

    def __init__(self, tokens: Tokens, metrics: Metrics) -> None:
        self._tokens = tokens
        self._metrics = metrics

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

        # The refusal must have the arity of the method that it replaces: some of them stream.
        if handler.request_streaming:
            return grpc.stream_stream_rpc_method_handler(refuse)
        if handler.response_streaming:
            return grpc.unary_stream_rpc_method_handler(refuse)
        return grpc.unary_unary_rpc_method_handler(refuse)
