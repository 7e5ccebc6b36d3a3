"""Calls with encoded bodies over gRPC and HTTP: no message is built or parsed on the way.

A client library would take more time per call than the measured server has cores to spare.
"""

import asyncio
import itertools
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, NamedTuple, Protocol

import grpc
from grpc import aio

from cab.forecast.v1.routes import PREDICT
from loadtest.requests import Encoding

CHANNELS = 4
"""Number of gRPC connections."""
GIVE_UP = 40.0
"""Seconds after which a call without a deadline counts as lost; servers answer within 30 s."""

_OPTIONS = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),
    ("grpc.enable_retries", 0),
    ("grpc.use_local_subchannel_pool", 1),  # channels of the same address would share one connection
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 500),
)
_CODES: Mapping[int, str] = {
    200: "OK",
    412: "FAILED_PRECONDITION",
    429: "RESOURCE_EXHAUSTED",
    503: "UNAVAILABLE",
    504: "DEADLINE_EXCEEDED",
}
_HEAD_BYTES = 2**16
_LATEST = 0.5
"""Seconds after the deadline for which a REST client still waits for the refusal or the late answer."""


class Reply(NamedTuple):
    """Reply to a call."""

    code: str
    """Canonical status code; "LOST": the connection failed or nothing came; "HTTP …": another status."""
    body: bytes = b""


class Wire(Protocol):
    """Connection to a method of a server."""

    async def call(self, body: bytes, time_left: float | None) -> Reply:
        """Send a request and return the reply.

        Args:
            body: the encoded request.
            time_left: seconds until the deadline; None: there is none.
        """

    async def close(self) -> None:
        """Close all connections."""


class Transport(StrEnum):
    """Transports of the contract."""

    GRPC = "grpc"
    REST = "rest"


def connect(transport: Transport, address: str, encoding: Encoding) -> Wire:
    """Return a connection to the Predict method of a server.

    Args:
        transport: gRPC or REST.
        address: HOST:PORT.
        encoding: encoding of the bodies over REST.
    """
    return GrpcWire(address) if transport is Transport.GRPC else RestWire(address, encoding.media_type)


class GrpcWire:
    """Calls over a few gRPC channels in turn.

    Args:
        address: HOST:PORT.
        method: full name of the method, ``/package.Service/Method``.
    """

    def __init__(self, address: str, method: str = PREDICT.rpc) -> None:
        self._channels = [aio.insecure_channel(address, _OPTIONS) for _ in range(CHANNELS)]
        methods: list[Any] = [channel.unary_unary(method, None, None) for channel in self._channels]
        self._methods = itertools.cycle(methods)

    async def call(self, body: bytes, time_left: float | None) -> Reply:
        """See ``Wire.call``."""
        try:
            answer: bytes = await next(self._methods)(body, timeout=time_left or GIVE_UP)
        except aio.AioRpcError as error:
            if error.code() is grpc.StatusCode.DEADLINE_EXCEEDED and time_left is None:
                return Reply("LOST")
            return Reply(error.code().name)
        return Reply("OK", answer)

    async def close(self) -> None:
        """See ``Wire.close``."""
        for channel in self._channels:
            await channel.close(None)


class RestWire:
    """Calls over as many HTTP/1.1 connections as there are calls at a time.

    Args:
        address: HOST:PORT.
        media_type: media type of requests and answers.
        path: path of the method.
    """

    def __init__(self, address: str, media_type: str, path: str = PREDICT.path) -> None:
        self._host, _, port = address.rpartition(":")
        self._port = int(port)
        self._head = (
            f"POST {path} HTTP/1.1\r\nHost: {address}\r\n"
            f"Content-Type: {media_type}\r\nAccept: {media_type}, */*;q=0.1\r\n"
        )
        self._idle: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = []

    async def call(self, body: bytes, time_left: float | None) -> Reply:
        """See ``Wire.call``."""
        head = self._head + (f"Request-Timeout: {time_left:.6f}\r\n" if time_left is not None else "")
        message = f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body
        try:
            async with asyncio.timeout(GIVE_UP if time_left is None else time_left + _LATEST):
                return await self._exchange(message)
        except TimeoutError:
            return Reply("LOST" if time_left is None else "DEADLINE_EXCEEDED")
        except (OSError, EOFError):
            return Reply("UNAVAILABLE")

    async def close(self) -> None:
        """See ``Wire.close``."""
        for _, writer in self._idle:
            writer.close()
        self._idle.clear()

    async def _exchange(self, message: bytes) -> Reply:
        while self._idle:
            reader, writer = self._idle.pop()
            if reader.at_eof() or writer.is_closing():  # the server closed it while it was idle
                writer.close()
                continue
            try:
                return await self._send(reader, writer, message)
            except (OSError, EOFError):  # the server closed it at the same moment: any client tries again
                break
        reader, writer = await asyncio.open_connection(self._host, self._port, limit=_HEAD_BYTES)
        return await self._send(reader, writer, message)

    async def _send(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, message: bytes
    ) -> Reply:
        kept = False
        try:
            writer.write(message)
            status, headers = await read_head(reader)
            body = await reader.readexactly(int(headers.get("content-length", "0")))
            kept = headers.get("connection", "").lower() != "close"
        finally:
            if kept:
                self._idle.append((reader, writer))
            else:  # also after a timeout or a cancellation, which the server notices by this
                writer.close()
        return Reply(_CODES.get(status, f"HTTP {status}"), body)


async def read_head(reader: asyncio.StreamReader) -> tuple[int, dict[str, str]]:
    """Return status and headers of an HTTP response; the names of the headers are in lower case.

    Raises:
        EOFError: the connection was closed.
    """
    first, *lines = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
    headers = dict(line.split(": ", 1) for line in lines if ": " in line)
    return int(first.split(" ", 2)[1]), {name.lower(): value for name, value in headers.items()}
