"""What a client asks of a transport."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from cab_forecast.endpoints import Endpoint
from cab_forecast.methods import Method, Request, Response
from cab_forecast.streams import Opened, Stream
from cab_forecast.timing import Budget

Encoding = Literal["protobuf", "json"]


@dataclass(frozen=True)
class Connection:
    """What both transports need to know to reach a server."""

    endpoint: Endpoint
    token: str | None
    encoding: Encoding
    """Of REST bodies; gRPC knows protobuf only."""
    ca_file: Path | None
    """PEM certificates to trust instead of the system's; None: the system's."""


class Transport(Protocol):
    """One attempt at a call, blocking."""

    def call(self, method: Method[Request, Response], request: Request, budget: Budget) -> Response:
        """Sends the request and waits for the answer.

        Raises:
            ForecastError: there is no answer.
        """
        ...

    def open(self, method: Method[Request, Response], request: Request, budget: Budget) -> Stream[Response]:
        """Sends the request and waits until the server has begun to answer; the messages come in their own
        time.

        Raises:
            ForecastError: it has not.
        """
        ...

    def close(self) -> None:
        """Frees the connections."""
        ...


class AsyncTransport(Protocol):
    """One attempt at a call, for asyncio."""

    async def call(self, method: Method[Request, Response], request: Request, budget: Budget) -> Response:
        """As ``Transport.call``."""
        ...

    async def open(
        self, method: Method[Request, Response], request: Request, budget: Budget
    ) -> Opened[Response]:
        """As ``Transport.open``."""
        ...

    async def close(self) -> None:
        """Frees the connections."""
        ...
