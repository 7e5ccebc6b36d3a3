"""Calls over REST."""

import asyncio
import socket
import ssl
from collections.abc import AsyncGenerator, Iterator
from contextlib import suppress

import httpx

from cab_forecast.events import EventReader
from cab_forecast.methods import Method, Request, Response
from cab_forecast.rest_codec import Codec
from cab_forecast.streams import Opened, Stream
from cab_forecast.timing import Budget, StreamTimes
from cab_forecast.transport import Connection

SILENCE = 45.0
"""s without a byte after which a stream is taken for lost: three of the server's heartbeats."""


class RestTransport:
    """Blocking calls over a pool of connections; usable from several threads."""

    def __init__(self, connection: Connection) -> None:
        self._codec = Codec(connection)
        self._client = httpx.Client(verify=_verify(connection))

    def call(self, method: Method[Request, Response], request: Request, budget: Budget) -> Response:
        """As ``Transport.call``."""
        sent = self._codec.request(method, request, budget)
        try:
            response = self._client.send(sent, stream=True)
            try:
                complete = _read(response, budget)
            finally:
                response.close()
        except httpx.TransportError as error:
            raise self._codec.lost(error, budget) from error
        return self._codec.answer(method, complete)

    def open(self, method: Method[Request, Response], request: Request, budget: Budget) -> Stream[Response]:
        """As ``Transport.open``."""
        times = StreamTimes(budget, SILENCE)
        sent = self._codec.stream_request(method, request, times)
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
            raise self._codec.lost(error, budget) from error
        times.begun = True
        return Stream(self._messages(response, method), lambda: _hang_up(response))

    def close(self) -> None:
        """As ``Transport.close``."""
        self._client.close()

    def _messages(self, response: httpx.Response, method: Method[Request, Response]) -> Iterator[Response]:
        reader = EventReader(method.response)
        try:
            for chunk in response.iter_bytes():
                yield from reader.feed(chunk)
        except httpx.TransportError as error:
            raise self._codec.cut(error, SILENCE) from error


class AsyncRestTransport:
    """Calls over a pool of connections, for asyncio."""

    def __init__(self, connection: Connection) -> None:
        self._codec = Codec(connection)
        self._client = httpx.AsyncClient(verify=_verify(connection))

    async def call(self, method: Method[Request, Response], request: Request, budget: Budget) -> Response:
        """As ``AsyncTransport.call``."""
        sent = self._codec.request(method, request, budget)
        try:
            # httpx bounds each read by itself: a body that trickles would never be late
            async with asyncio.timeout(budget.remaining()):
                response = await self._client.send(sent)
        except (httpx.TransportError, TimeoutError) as error:
            raise self._codec.lost(error, budget) from error
        return self._codec.answer(method, response)

    async def open(
        self, method: Method[Request, Response], request: Request, budget: Budget
    ) -> Opened[Response]:
        """As ``AsyncTransport.open``."""
        times = StreamTimes(budget, SILENCE)
        sent = self._codec.stream_request(method, request, times)
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
            raise self._codec.lost(error, budget) from error
        times.begun = True
        return Opened(self._messages(response, method), response.aclose)

    async def close(self) -> None:
        """As ``AsyncTransport.close``."""
        await self._client.aclose()

    async def _messages(
        self, response: httpx.Response, method: Method[Request, Response]
    ) -> AsyncGenerator[Response]:
        reader = EventReader(method.response)
        try:
            async for chunk in response.aiter_bytes():
                for message in reader.feed(chunk):
                    yield message
        except httpx.TransportError as error:
            raise self._codec.cut(error, SILENCE) from error


def _read(response: httpx.Response, budget: Budget) -> httpx.Response:
    """A streamed response with its body.

    httpx bounds each read of a body by what was left when the body began, so that one which trickles would
    never be late. Here the clock is looked at after each read: the last one may overrun, no more.

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


def _hang_up(response: httpx.Response) -> None:
    """Ends a response; a thread that waits for more of it finds the end."""
    stream = response.extensions.get("network_stream")
    connection = stream.get_extra_info("socket") if stream is not None else None
    if connection is not None:
        # To close a socket does not wake who reads from it
        with suppress(OSError):
            connection.shutdown(socket.SHUT_RDWR)
    response.close()


def _verify(connection: Connection) -> ssl.SSLContext | bool:
    return ssl.create_default_context(cafile=connection.ca_file) if connection.ca_file else True
