"""HTTP connections within bounds of number, time and size of headers.

uvicorn bounds none of these: without bounds, connections that never finish their headers would stay, and
grow, for as long as their clients want.
"""

import asyncio
from collections.abc import Callable, Sized
from dataclasses import dataclass, field
from typing import Any, Protocol

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

MAX_HEADER_BYTES = 64 * 2**10
"""Max size of the headers of a request."""
_LINGER = 1.0
"""Seconds after the body timeout in which the call itself can answer."""


class HasTransport(Protocol):
    """Connection that can be aborted."""

    transport: asyncio.Transport


@dataclass
class Connections:
    """Limits of the connections of one server."""

    max_connections: int
    header_timeout: float
    """Seconds from the connection, or the first byte of a later request, to the end of its headers."""
    body_timeout: float
    """Seconds from the end of the headers to the end of the body."""
    max_age: float | None
    """Seconds after which a response asks the client to open a new connection; None: never."""
    write_timeout: float
    """Seconds for which a client may leave a full buffer of its response unread."""
    waiting: "dict[BoundedProtocol, None]" = field(default_factory=dict)
    """Connections without a request in progress, longest waiting first."""
    handshakes: "dict[HasTransport, None]" = field(default_factory=dict)
    """Connections whose TLS handshake is not done, oldest first."""

    def make_room(self, connections: Sized) -> None:
        """Close a connection if there are too many: the oldest handshake, else the one that waits longest.

        Args:
            connections: those whose handshake is done.
        """
        if len(connections) + len(self.handshakes) <= self.max_connections:
            return
        oldest = self.handshakes or self.waiting
        for connection in oldest:
            del oldest[connection]  # type: ignore[arg-type]  # it is of this dictionary
            connection.transport.abort()
            break


class BoundedProtocol(HttpToolsProtocol):
    """HTTP/1.1 connection with timeouts while it receives and sends, and a limit of its headers.

    Beyond ``max_connections`` a new connection takes the place of the one that has been waiting longest for
    the headers of a request. So connections that send none, or half of them, do not keep others out.
    """

    def __init__(self, limits: Connections, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._limits = limits
        self._header_bytes = 0
        self._in_headers = True
        self._made = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._writing: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Count the connection, and wait for its headers."""
        super().connection_made(transport)
        self._made = self.loop.time()
        self._limits.waiting[self] = None
        self._set_timer(self._limits.header_timeout, self._on_header_timeout)
        self._limits.make_room(self.connections)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._limits.waiting.pop(self, None)
        self._set_timer(None)
        self._stop_write_timer()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Wait for the client to read: the buffer of the response is full."""
        super().pause_writing()
        self._stop_write_timer()
        self._writing = self.loop.call_later(self._limits.write_timeout, self.transport.abort)

    def resume_writing(self) -> None:
        """Stop waiting: the client has read."""
        super().resume_writing()
        self._stop_write_timer()

    def data_received(self, data: bytes) -> None:
        """Parse data; refuse headers that are too large."""
        super().data_received(data)
        if self._in_headers and not self.transport.is_closing():
            self._header_bytes += len(data)
            if self._header_bytes > MAX_HEADER_BYTES:
                self._refuse(b"431 Request Header Fields Too Large")

    def on_message_begin(self) -> None:
        """Wait for the headers of a request."""
        super().on_message_begin()
        self._in_headers = True
        self._header_bytes = 0
        self._set_timer(self._limits.header_timeout, self._on_header_timeout)

    def on_headers_complete(self) -> None:
        """Start the call, and wait for its body."""
        self._in_headers = False
        self._limits.waiting.pop(self, None)
        self._set_timer(self._limits.body_timeout + _LINGER, self._on_body_timeout)
        super().on_headers_complete()
        max_age = self._limits.max_age
        if max_age is not None and self.loop.time() - self._made > max_age:
            self.cycle.keep_alive = False  # uvicorn tells the client

    def on_message_complete(self) -> None:
        """Stop waiting: the request has arrived."""
        self._set_timer(None)
        super().on_message_complete()
        self._wait_for_request()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._wait_for_request()

    def _wait_for_request(self) -> None:
        """Let other connections take the place of this one if it is idle."""
        idle = self._timer is None and self.cycle is not None and self.cycle.response_complete
        if idle and not self.pipeline and self in self.connections:
            self._limits.waiting[self] = None

    def _on_header_timeout(self) -> None:
        self._refuse(b"408 Request Timeout")

    def _on_body_timeout(self) -> None:
        if self.flow.read_paused:  # the server holds the body back, behind an earlier request
            self._set_timer(self._limits.body_timeout, self._on_body_timeout)
        else:
            self.transport.close()

    def _refuse(self, status: bytes) -> None:
        """Close the connection, with a status unless a response is being sent on it."""
        if self.cycle is None or self.cycle.response_complete:
            self.transport.write(
                b"HTTP/1.1 " + status + b"\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"
            )
        self.transport.close()

    def _stop_write_timer(self) -> None:
        if self._writing is not None:
            self._writing.cancel()
            self._writing = None

    def _set_timer(self, seconds: float | None, on_timeout: Callable[[], None] | None = None) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if seconds is not None and on_timeout is not None:
            self._timer = self.loop.call_later(seconds, on_timeout)
