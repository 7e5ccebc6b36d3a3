"""TLS handshakes of HTTP connections."""

import asyncio
import ssl
from typing import Any

import structlog

from service.access.tls import Certificates
from service.access.watched import Watched
from service.transports.rest.connections import BoundedProtocol, Connections

_log = structlog.get_logger(__name__)


class Handshake(asyncio.Protocol):
    """Protocol of a new connection until its TLS handshake is done and HTTP begins on it.

    Each connection gets the certificates as they are at its beginning. (``create_server`` would keep those of
    the start, and would not count connections before their handshake is done.)
    """

    def __init__(self, limits: Connections, certificates: Watched[Certificates], **arguments: Any) -> None:
        """
        Args:
            limits: count the connection, and bound the time of the handshake.
            certificates: the latest certificates.
            arguments: those of ``BoundedProtocol``.
        """
        self._limits = limits
        self._certificates = certificates
        self._http = BoundedProtocol(limits, **arguments)
        self._early = bytearray()
        self._lost = False
        self._task: asyncio.Task[None] | None = None
        self.transport: Any = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin the handshake."""
        self.transport = transport
        self.transport.pause_reading()  # what the client sends is for TLS
        self._limits.handshakes[self] = None
        self._limits.make_room(self._http.connections)
        self._task = asyncio.get_running_loop().create_task(self._secure())

    def data_received(self, data: bytes) -> None:
        """Keep what arrives with the end of the handshake, before HTTP has begun."""
        self._early += data

    def connection_lost(self, exc: Exception | None) -> None:
        """Note that HTTP must not begin."""
        self._lost = True

    async def _secure(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            transport = await loop.start_tls(
                self.transport,
                self,
                self._certificates.value.context,
                server_side=True,
                ssl_handshake_timeout=self._limits.header_timeout,
            )
        except (OSError, ssl.SSLError) as error:  # time-outs and lost connections are OSErrors
            _log.debug("TLS handshake failed", reason=str(error))
            self.transport.abort()
            return
        finally:
            self._limits.handshakes.pop(self, None)
        if transport is None or self._lost:
            return
        transport.set_protocol(self._http)
        self._http.connection_made(transport)
        if self._early:
            self._http.data_received(bytes(self._early))
