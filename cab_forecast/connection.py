"""Connection to a server: the client's settings, and the interface of the transports."""

import os
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal, Protocol

from cab.forecast.v1.routes import Request, Response, Route
from cab_forecast.endpoints import Endpoint, parse_endpoint
from cab_forecast.streams import OpenStream, Stream
from cab_forecast.timing import Budget

DEFAULT_TIMEOUT = 5.0
"""Seconds for a call, retries included."""
DEFAULT_RETRIES = 2
_VARIABLES = {
    "endpoint": "CAB_FORECAST_ENDPOINT",
    "token": "CAB_FORECAST_TOKEN",
    "ca_file": "CAB_FORECAST_CA_FILE",
    "certificate_file": "CAB_FORECAST_CERTIFICATE_FILE",
    "key_file": "CAB_FORECAST_KEY_FILE",
}
"""Environment variable of each argument of a client that can be set by one."""

Encoding = Literal["protobuf", "json"]


@dataclass(frozen=True)
class Connection:
    """The server to reach, and how: the settings that transports share."""

    endpoint: Endpoint
    token: str | None
    encoding: Encoding
    """Encoding of REST bodies; gRPC always uses protobuf."""
    ca_file: Path | None
    """PEM certificates to trust instead of the system's; None: the system's."""
    certificate: tuple[Path, Path] | None = None
    """PEM certificate of the client and its private key; None: the client presents none."""

    @property
    def may_need_certificate(self) -> bool:
        """True if the connection uses TLS without a certificate of the client."""
        return self.endpoint.secure and self.certificate is None


def from_variables() -> dict[str, str]:
    """Return the arguments of a client that environment variables set."""
    return {argument: os.environ[name] for argument, name in _VARIABLES.items() if name in os.environ}


class Transport(Protocol):
    """Blocking transport; each method makes one attempt."""

    def call(self, route: Route[Request, Response], request: Request, budget: Budget) -> Response:
        """Send a request and wait for the response.

        Raises:
            ForecastError: the call failed.
        """
        ...

    def open(self, route: Route[Request, Response], request: Request, budget: Budget) -> Stream[Response]:
        """Send a request and wait until the server has started to respond; the budget ends there.

        Raises:
            ForecastError: the call failed.
        """
        ...

    def close(self) -> None:
        """Close the connections."""
        ...


class AsyncTransport(Protocol):
    """Transport for asyncio; each method makes one attempt."""

    async def call(self, route: Route[Request, Response], request: Request, budget: Budget) -> Response:
        """See ``Transport.call``."""
        ...

    async def open(
        self, route: Route[Request, Response], request: Request, budget: Budget
    ) -> OpenStream[Response]:
        """See ``Transport.open``."""
        ...

    async def close(self) -> None:
        """Close the connections."""
        ...


class ClientSettings:
    """Validated arguments of a client."""

    def __init__(
        self,
        endpoint: str,
        token: str | None,
        timeout: float,
        retries: int,
        *,
        encoding: Encoding,
        ca_file: str | PathLike[str] | None,
        certificate_file: str | PathLike[str] | None,
        key_file: str | PathLike[str] | None,
    ) -> None:
        """See ``Client``.

        Raises:
            ValueError: an argument is out of range.
        """
        if retries < 0:
            raise ValueError(f"retries must not be negative, but is {retries}")
        if encoding not in ("protobuf", "json"):
            raise ValueError(f"encoding must be 'protobuf' or 'json', not {encoding!r}")
        Budget(timeout)  # refuse an invalid timeout here, not at the first call
        if (certificate_file is None) != (key_file is None):
            raise ValueError("certificate_file and key_file go together")
        certificate = None
        if certificate_file is not None and key_file is not None:
            certificate = Path(certificate_file), Path(key_file)
        self.connection = Connection(
            parse_endpoint(endpoint),
            token,
            encoding,
            None if ca_file is None else Path(ca_file),
            certificate,
        )
        if encoding == "json" and self.connection.endpoint.transport == "grpc":
            raise ValueError("encoding='json' is for http:// and https:// endpoints; gRPC uses protobuf")
        self.timeout = timeout
        self.retries = retries
        self.closed = False

    def budget(self, timeout: float | None) -> Budget:
        """Start the time budget of one call.

        Args:
            timeout: seconds; None: the client's timeout.

        Raises:
            RuntimeError: the client is closed.
        """
        if self.closed:
            raise RuntimeError("this client is closed")
        return Budget(self.timeout if timeout is None else timeout)
