"""gRPC transports: a blocking one, and one for asyncio."""

import asyncio
import threading
from collections.abc import AsyncGenerator, Iterator, Sequence
from typing import Any

import grpc
from google.protobuf import any_pb2
from google.protobuf.message import Message
from google.rpc.error_details_pb2 import BadRequest, ErrorInfo, RequestInfo, RetryInfo
from grpc import aio
from grpc.aio import EOF  # type: ignore[attr-defined]  # the stubs lack it
from grpc_status import rpc_status

from cab.forecast.v1.routes import Request, Response, Route
from cab_forecast.connection import Connection
from cab_forecast.endpoints import Endpoint
from cab_forecast.errors import TOO_LARGE, FieldViolation, ForecastError, connection_failed, error_for
from cab_forecast.streams import OpenStream, Stream
from cab_forecast.timing import Budget

_OPTIONS: Sequence[tuple[str, int | str]] = (
    # Responses for hundreds of agents with samples exceed gRPC's default of 4 MiB; the server limits them.
    ("grpc.max_receive_message_length", -1),
    # The client retries by itself, after the time that the server asks for.
    ("grpc.enable_retries", 0),
    # The addresses of a name are several servers: calls go in turn to each that can be reached.
    ("grpc.lb_policy_name", "round_robin"),
    # Reconnect to a server that went away as quickly as the client retries.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2000),
    # Check that the server is alive while calls are open, so that idle streams notice a lost connection.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 20_000),
    ("grpc.http2.max_pings_without_data", 0),
)

_BROKEN_OFF = "Socket closed"
"""Part of gRPC's message about a server that ended the connection, as one that misses a certificate does."""

_BROKEN_RESPONSE = ("Stream removed", "RST_STREAM")
"""Parts of gRPC's messages about a response that broke off, as a proxy ends it when its server is gone."""


class GrpcTransport:
    """Blocking transport over one channel; usable from several threads."""

    def __init__(self, connection: Connection) -> None:
        endpoint = connection.endpoint
        self._connection = connection
        self._metadata = _metadata(connection)
        self._channel = (
            grpc.secure_channel(endpoint.target, _credentials(connection), _options(endpoint))
            if endpoint.secure
            else grpc.insecure_channel(endpoint.target, _options(endpoint))
        )

    def call(self, route: Route[Request, Response], request: Request, budget: Budget) -> Response:
        """See ``Transport.call``."""
        invoke = self._channel.unary_unary(route.rpc, _serialize, route.response.FromString)
        try:
            response: Response = invoke(request, timeout=budget.remaining(), metadata=self._metadata)
        except grpc.RpcError as error:
            raise error_from_call(error, self._connection) from error
        return response

    def open(self, route: Route[Request, Response], request: Request, budget: Budget) -> Stream[Response]:
        """See ``Transport.open``."""
        invoke = self._channel.unary_stream(route.rpc, _serialize, route.response.FromString)
        left = budget.remaining()  # bounds the start only: the call itself has no deadline
        # Both an iterator and a call; the stubs know the iterator only.
        call: Any = invoke(request, metadata=self._metadata)
        late = threading.Event()

        def time_out() -> None:
            late.set()
            call.cancel()

        timer = threading.Timer(left, time_out)  # nothing else bounds the wait for the first message
        timer.start()
        try:
            first = next(call, None)
        except grpc.RpcError as error:
            if late.is_set():
                raise budget.exceeded() from error
            raise error_from_call(error, self._connection) from error
        except BaseException:
            call.cancel()
            raise
        finally:
            timer.cancel()
        return Stream(_messages(call, first, self._connection), call.cancel)

    def close(self) -> None:
        """See ``Transport.close``."""
        self._channel.close()


class AsyncGrpcTransport:
    """Transport over one channel, for asyncio; created and used in one event loop."""

    def __init__(self, connection: Connection) -> None:
        endpoint = connection.endpoint
        self._connection = connection
        self._metadata = _metadata(connection)
        self._channel = (
            aio.secure_channel(endpoint.target, _credentials(connection), _options(endpoint))
            if endpoint.secure
            else aio.insecure_channel(endpoint.target, _options(endpoint))
        )

    async def call(self, route: Route[Request, Response], request: Request, budget: Budget) -> Response:
        """See ``AsyncTransport.call``."""
        invoke = self._channel.unary_unary(route.rpc, _serialize, route.response.FromString)
        try:
            response: Response = await invoke(request, timeout=budget.remaining(), metadata=self._metadata)
        except aio.AioRpcError as error:
            raise error_from_call(error, self._connection) from error
        return response

    async def open(
        self, route: Route[Request, Response], request: Request, budget: Budget
    ) -> OpenStream[Response]:
        """See ``AsyncTransport.open``."""
        invoke = self._channel.unary_stream(route.rpc, _serialize, route.response.FromString)
        left = budget.remaining()
        call = invoke(request, metadata=self._metadata)
        try:
            async with asyncio.timeout(left):
                first = await call.read()
        except aio.AioRpcError as error:
            raise error_from_call(error, self._connection) from error
        except TimeoutError as error:
            call.cancel()
            raise budget.exceeded() from error
        except BaseException:
            call.cancel()
            raise

        async def cancel() -> None:
            call.cancel()

        return OpenStream(_async_messages(call, first, self._connection), cancel)

    async def close(self) -> None:
        """See ``AsyncTransport.close``."""
        await self._channel.close(None)


def _messages(call: Iterator[Response], first: Response | None, connection: Connection) -> Iterator[Response]:
    """Yield all messages except empty ones, which only say that the call has started."""
    message = first
    try:
        while message is not None:
            if message.ByteSize():
                yield message
            message = next(call, None)
    except grpc.RpcError as error:
        raise error_from_call(error, connection) from error


async def _async_messages(
    call: "aio.UnaryStreamCall[Request, Response]", first: Any, connection: Connection
) -> AsyncGenerator[Response]:
    """See ``_messages``."""
    message = first
    try:
        while message is not EOF:
            if message.ByteSize():
                yield message
            message = await call.read()
    except aio.AioRpcError as error:
        raise error_from_call(error, connection) from error


def error_from_call(call: grpc.RpcError, connection: Connection) -> ForecastError:
    """Return the exception for a failed call, from its status and the google.rpc details in its trailers.

    Args:
        call: the error that gRPC raised, which is the ended call as well.
        connection: the connection, for the message if the server could not be reached.
    """
    code, message = call.code().name, call.details() or ""
    reason, retry_after = "", None
    violations: list[FieldViolation] = []
    info, bad, retry, request = ErrorInfo(), BadRequest(), RetryInfo(), RequestInfo()
    details = _details(call)
    for detail in details:
        if detail.Unpack(info):
            reason = info.reason
        elif detail.Unpack(bad):
            violations += [FieldViolation(v.field, v.description) for v in bad.field_violations]
        elif detail.Unpack(retry):
            retry_after = retry.retry_delay.ToNanoseconds() / 1e9
        else:
            detail.Unpack(request)
    lost = code in ("UNKNOWN", "INTERNAL") and any(text in message for text in _BROKEN_RESPONSE)
    if not details and (code == "UNAVAILABLE" or lost):
        # The server's own UNAVAILABLE has details; this one comes from the channel.
        broken_off = _BROKEN_OFF in message
        return connection_failed(
            connection.endpoint.url,
            message,
            may_need_certificate=broken_off and connection.may_need_certificate,
        )
    if not details and code == "RESOURCE_EXHAUSTED" and "larger than max" in message:
        # gRPC's own size limit refused the message before the server's code could.
        reason = TOO_LARGE
    return error_for(
        code,
        message or code,
        reason=reason,
        field_violations=violations,
        retry_after=retry_after,
        request_id=request.request_id,
    )


def _details(call: grpc.RpcError) -> Sequence[any_pb2.Any]:
    try:
        status = rpc_status.from_call(call)  # type: ignore[arg-type] # the error is the call
    except ValueError:  # the details contradict the status, which takes precedence
        return ()
    return status.details if status else ()


def _metadata(connection: Connection) -> tuple[tuple[str, str], ...]:
    return (("authorization", f"Bearer {connection.token}"),) if connection.token else ()


def _options(endpoint: Endpoint) -> Sequence[tuple[str, int | str]]:
    """Return the options of a channel; a proxy in the environment leads to no server on this machine."""
    return [*_OPTIONS, ("grpc.enable_http_proxy", 0)] if endpoint.is_loopback else _OPTIONS


def _credentials(connection: Connection) -> grpc.ChannelCredentials:
    authorities = None if connection.ca_file is None else connection.ca_file.read_bytes()
    if connection.certificate is None:
        return grpc.ssl_channel_credentials(authorities)
    chain, key = (path.read_bytes() for path in connection.certificate)
    return grpc.ssl_channel_credentials(authorities, key, chain)


def _serialize(message: Message) -> bytes:
    return message.SerializeToString()
