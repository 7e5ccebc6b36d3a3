"""REST transports: a blocking one, and one for asyncio."""

import asyncio
import socket
import ssl
from collections.abc import AsyncGenerator, Iterator
from contextlib import suppress

import httpx

from cab.forecast.v1.routes import Request, Response, Route
from cab_forecast.connection import Connection
from cab_forecast.rest_codec import Codec, EventReader
from cab_forecast.streams import OpenStream, Stream
from cab_forecast.timing import Budget, StreamTimeouts

IDLE_TIMEOUT = 45.0
"""Seconds without a byte after which a stream counts as lost: three heartbeats of the server."""


class RestTransport:
    """Blocking transport over a pool of connections; usable from several threads."""

    def __init__(self, connection: Connection) -> None:
        self._codec = Codec(connection)
        self._client = httpx.Client(verify=_verify(connection), mounts=_without_proxy(connection))

    def call(self, route: Route[Request, Response], request: Request, budget: Budget) -> Response:
        """See ``Transport.call``."""
        sent = self._codec.request(route, request, budget)
        try:
            response = self._client.send(sent, stream=True)
            try:
                complete = _read(response, budget)
            finally:
                response.close()
        except httpx.TransportError as error:
            raise self._codec.connection_error(error, budget) from error
        return self._codec.decode(route, complete)

    def open(self, route: Route[Request, Response], request: Request, budget: Budget) -> Stream[Response]:
        """See ``Transport.open``."""
        timeouts = StreamTimeouts(budget, IDLE_TIMEOUT)
        sent = self._codec.stream_request(route, request, timeouts)
        try:
            response = self._client.send(sent, stream=True)
            try:
                if not response.is_success:
                    response = _read(response, budget)
                self._codec.check_stream(response)
            except BaseException:
                response.close()
                raise
        except httpx.TransportError as error:
            raise self._codec.connection_error(error, budget) from error
        timeouts.started = True
        return Stream(self._messages(response, route), lambda: _shut_down(response))

    def close(self) -> None:
        """See ``Transport.close``."""
        self._client.close()

    def _messages(self, response: httpx.Response, route: Route[Request, Response]) -> Iterator[Response]:
        reader = EventReader(route.response)
        try:
            for chunk in response.iter_bytes():
                yield from reader.feed(chunk)
        except httpx.TransportError as error:
            raise self._codec.stream_error(error, IDLE_TIMEOUT) from error


class AsyncRestTransport:
    """Transport over a pool of connections, for asyncio."""

    def __init__(self, connection: Connection) -> None:
        self._codec = Codec(connection)
        self._client = httpx.AsyncClient(verify=_verify(connection), mounts=_without_proxy(connection))

    async def call(self, route: Route[Request, Response], request: Request, budget: Budget) -> Response:
        """See ``AsyncTransport.call``."""
        sent = self._codec.request(route, request, budget)
        try:
            # httpx bounds each read separately: a body that trickles in would never time out.
            async with asyncio.timeout(budget.remaining()):
                response = await self._client.send(sent)
        except (httpx.TransportError, TimeoutError) as error:
            raise self._codec.connection_error(error, budget) from error
        return self._codec.decode(route, response)

    async def open(
        self, route: Route[Request, Response], request: Request, budget: Budget
    ) -> OpenStream[Response]:
        """See ``AsyncTransport.open``."""
        timeouts = StreamTimeouts(budget, IDLE_TIMEOUT)
        sent = self._codec.stream_request(route, request, timeouts)
        try:
            async with asyncio.timeout(budget.remaining()):
                response = await self._client.send(sent, stream=True)
                try:
                    if not response.is_success:
                        await response.aread()
                    self._codec.check_stream(response)
                except BaseException:
                    await response.aclose()
                    raise
        except (httpx.TransportError, TimeoutError) as error:
            raise self._codec.connection_error(error, budget) from error
        timeouts.started = True
        return OpenStream(self._messages(response, route), response.aclose)

    async def close(self) -> None:
        """See ``AsyncTransport.close``."""
        await self._client.aclose()

    async def _messages(
        self, response: httpx.Response, route: Route[Request, Response]
    ) -> AsyncGenerator[Response]:
        reader = EventReader(route.response)
        try:
            async for chunk in response.aiter_bytes():
                for message in reader.feed(chunk):
                    yield message
        except httpx.TransportError as error:
            raise self._codec.stream_error(error, IDLE_TIMEOUT) from error


def _read(response: httpx.Response, budget: Budget) -> httpx.Response:
    """Read the body of a streamed response.

    httpx bounds each read by the time that remained when the body began, so that a body that trickles in
    would never time out. Here the budget is checked after each read; only the last read may overrun it.

    Raises:
        DeadlineExceeded: the body took too long.
    """
    body = bytearray()
    for chunk in response.iter_raw():
        budget.remaining()
        body += chunk
    return httpx.Response(
        response.status_code, headers=response.headers, content=bytes(body), extensions=response.extensions
    )


def _shut_down(response: httpx.Response) -> None:
    """Close a response; a thread that reads from it finds the end."""
    stream = response.extensions.get("network_stream")
    connection = stream.get_extra_info("socket") if stream is not None else None
    if connection is not None:
        # Closing a socket does not wake a thread that reads from it; shutting it down does.
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
    response.close()


def _without_proxy(connection: Connection) -> dict[str, None]:
    """Return mounts for httpx: a proxy in the environment leads to no server on this machine."""
    endpoint = connection.endpoint
    return {f"all://{endpoint.host}": None} if endpoint.is_loopback else {}


def _verify(connection: Connection) -> ssl.SSLContext | bool:
    if connection.ca_file is None and connection.certificate is None:
        return True
    context = (
        httpx.create_ssl_context()
        if connection.ca_file is None
        else ssl.create_default_context(cafile=connection.ca_file)
    )
    if connection.certificate is not None:
        context.load_cert_chain(*connection.certificate)
    return context
