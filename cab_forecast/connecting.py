"""What both clients are made with: settings, checked, and the transport that they name."""

from os import PathLike
from pathlib import Path

from cab_forecast.endpoints import parse_endpoint
from cab_forecast.timing import Budget
from cab_forecast.transport import AsyncTransport, Connection, Encoding, Transport

DEFAULT_TIMEOUT = 5.0
"""s for a call, retries included."""
DEFAULT_RETRIES = 2


class ClientSettings:
    """What a client was made with, checked."""

    def __init__(
        self,
        endpoint: str,
        token: str | None,
        timeout: float,
        retries: int,
        *,
        encoding: Encoding,
        ca_file: str | PathLike[str] | None,
    ) -> None:
        """As ``Client``.

        Raises:
            ValueError: an argument is out of its range.
        """
        if retries < 0:
            raise ValueError(f"retries must not be negative, but is {retries}")
        if encoding not in ("protobuf", "json"):
            raise ValueError(f"encoding must be 'protobuf' or 'json', not {encoding!r}")
        Budget(timeout)  # refuses what is no timeout here rather than at the first call
        self.connection = Connection(
            parse_endpoint(endpoint), token, encoding, Path(ca_file) if ca_file is not None else None
        )
        if encoding == "json" and self.connection.endpoint.transport == "grpc":
            raise ValueError("encoding='json' is for http:// and https:// endpoints; gRPC speaks protobuf")
        self.timeout = timeout
        self.retries = retries
        self.closed = False

    def budget(self, timeout: float | None) -> Budget:
        """The time for one call.

        Raises:
            RuntimeError: the client is closed.
        """
        if self.closed:
            raise RuntimeError("this client is closed")
        return Budget(self.timeout if timeout is None else timeout)


def open_transport(connection: Connection) -> Transport:
    """The transport that the endpoint names."""
    # Imported here: whoever speaks one transport needs not load the other.
    if connection.endpoint.transport == "grpc":
        from cab_forecast.grpc_transport import GrpcTransport  # noqa: PLC0415

        return GrpcTransport(connection)
    from cab_forecast.rest_transport import RestTransport  # noqa: PLC0415

    return RestTransport(connection)


def open_async_transport(connection: Connection) -> AsyncTransport:
    """As ``open_transport``, for asyncio."""
    if connection.endpoint.transport == "grpc":
        from cab_forecast.grpc_transport import AsyncGrpcTransport  # noqa: PLC0415

        return AsyncGrpcTransport(connection)
    from cab_forecast.rest_transport import AsyncRestTransport  # noqa: PLC0415

    return AsyncRestTransport(connection)
