"""The gRPC server."""

from grpc import aio
from grpc_health.v1 import health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from service.predict.pipeline import DataPlane
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.transports.auth import Tokens
from service.transports.grpc.handlers import SERVICES, Handlers
from service.transports.grpc.health import HEALTH_SERVICE, Health
from service.transports.grpc.interceptor import AuthInterceptor

_UNLIMITED = -1
_TRANSPORT_MARGIN = 2
"""Up to this many times the request limit a message is received, to be refused with details; beyond it
gRPC itself refuses, with the same code but without."""
_KEEPALIVE = (
    # A client that vanished without a word is found out in about a minute; its watches would never end
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 20_000),
    ("grpc.http2.max_pings_without_data", 0),  # as many as it takes
    ("grpc.http2.min_ping_interval_without_data_ms", 10_000),  # of clients that do the same
)


class GrpcServer:
    """The contract's services with health and reflection on one port."""

    def __init__(self, dataplane: DataPlane, metrics: Metrics, settings: Settings) -> None:
        self._settings = settings
        self._server = aio.server(
            interceptors=[AuthInterceptor(Tokens(settings.api_tokens), metrics)],
            options=[
                ("grpc.max_receive_message_length", settings.max_request_bytes * _TRANSPORT_MARGIN),
                ("grpc.max_send_message_length", _UNLIMITED),
                ("grpc.so_reuseport", 0),  # or a second server would share the port in silence
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
        """HOST:PORT that is listened on."""

    async def start(self) -> None:
        """Listens; calls are answered from now on.

        Raises:
            OSError: the port is taken or the host is not ours.
        """
        host = self._settings.grpc.rpartition(":")[0]
        try:
            port = self._server.add_insecure_port(self._settings.grpc)
        except RuntimeError as error:
            raise OSError(str(error)) from error
        self.address = f"{host}:{port}"
        await self._server.start()

    def set_serving(self, serving: bool) -> None:
        """Tells health, for "" and each service."""
        self._health.set_serving(serving)

    async def stop(self, grace: float) -> None:
        """Takes no more calls and gives those under way so many seconds."""
        self._health.close()
        await self._server.stop(grace)
