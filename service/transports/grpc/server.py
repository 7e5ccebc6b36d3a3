"""gRPC server: the contract's services, health and reflection on one port."""

from typing import Any

import grpc
from grpc import aio
from grpc_health.v1 import health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from cab.forecast.v1.routes import SERVICES
from service.access.access import Access
from service.access.tls import Certificates
from service.predict.dataplane import DataPlane
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.telemetry.tracing import Tracing
from service.transports.calls import CallRecords
from service.transports.grpc.gate import GateInterceptor
from service.transports.grpc.handlers import Handlers
from service.transports.grpc.health import HEALTH_SERVICE, Health
from service.transports.grpc.intake import RECEIVE_MARGIN, IntakeInterceptor
from service.transports.grpc.request_ids import RequestIdInterceptor
from service.transports.intake import Intake

_UNLIMITED = -1
MIN_PING_INTERVAL = 5.0
"""Seconds between pings of a client that are accepted. Clients may ping every 10 s; networks deliver some
pings late and the next ones on time. After three pings too early gRPC ends the connection."""
_KEEPALIVE = (
    # Detect within about a minute that a client has vanished; its streams would never end otherwise.
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 20_000),
    ("grpc.http2.max_pings_without_data", 0),  # unlimited
    # Without it a client without calls in progress may ping every two hours only.
    ("grpc.keepalive_permit_without_calls", 1),
)


class GrpcServer:
    """The gRPC server, with the contract's services, health and reflection."""

    def __init__(
        self,
        dataplane: DataPlane,
        metrics: Metrics,
        settings: Settings,
        intake: Intake,
        access: Access,
        tracing: Tracing | None = None,
    ) -> None:
        self._settings = settings
        self._access = access
        records = CallRecords("grpc", metrics, settings, tracing)
        self._server = aio.server(
            interceptors=[
                RequestIdInterceptor(),
                GateInterceptor(access.gate, records),
                IntakeInterceptor(intake, records, settings),
            ],
            options=[
                ("grpc.max_receive_message_length", settings.max_request_bytes * RECEIVE_MARGIN),
                ("grpc.server_handshake_timeout_ms", max(round(settings.header_timeout * 1000), 1)),
                ("grpc.max_send_message_length", _UNLIMITED),
                ("grpc.so_reuseport", 0),  # otherwise a second server would silently share the port
                ("grpc.http2.min_ping_interval_without_data_ms", round(MIN_PING_INTERVAL * 1000)),
                *_KEEPALIVE,
                *_connection_age(settings.max_connection_age),
            ],
        )
        self._health = Health(SERVICES)
        handlers = Handlers(dataplane, records, settings)
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
            credentials = _credentials(self._access)
            port = (
                self._server.add_insecure_port(self._settings.grpc)
                if credentials is None
                else self._server.add_secure_port(self._settings.grpc, credentials)
            )
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


def _connection_age(seconds: float | None) -> list[tuple[str, int]]:
    """Return the option of the age; calls in progress get as long as they need."""
    return [] if seconds is None else [("grpc.max_connection_age_ms", max(round(seconds * 1000), 1))]


def _credentials(access: Access) -> grpc.ServerCredentials | None:
    """Return credentials with the certificates as they are when a client connects; None: there is no TLS."""
    certificates = access.certificates
    if certificates is None:
        return None
    sent = certificates.value

    def changed() -> Any:  # the stubs lack None, which means: go on with those that were sent
        nonlocal sent
        if certificates.value is sent:
            return None
        sent = certificates.value
        return _configuration(sent)

    return grpc.dynamic_ssl_server_credentials(
        _configuration(sent), changed, require_client_authentication=access.requires_client_certificates
    )


def _configuration(certificates: Certificates) -> grpc.ServerCertificateConfiguration:
    pair = (certificates.key, certificates.chain)
    return grpc.ssl_server_certificate_configuration([pair], certificates.client_ca)
