"""The options and errors shared by commands that call a server."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from cli.failures import fail

if TYPE_CHECKING:
    from cab_forecast.client import Client
    from cab_forecast.errors import ForecastError

Endpoint = Annotated[
    str, typer.Option(envvar="CAB_FORECAST_ENDPOINT", help="grpc://, grpcs://, http:// or https://")
]
Token = Annotated[str | None, typer.Option(envvar="CAB_FORECAST_TOKEN", help="Bearer token of the server.")]
Timeout = Annotated[float, typer.Option(help="Seconds per call, retries included.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the response as JSON instead of a table.")]

DEFAULT_TIMEOUT = 5.0


@dataclass(frozen=True)
class Connection:
    """A server and how to call it."""

    endpoint: str
    token: str | None
    timeout: float
    """Seconds per call, retries included."""


@contextmanager
def connect(connection: Connection) -> Iterator["Client"]:
    """Open a client; turn its errors into one line on standard error.

    Raises:
        typer.Exit: with code 1, when a call fails.
    """
    from cab_forecast.client import Client  # noqa: PLC0415
    from cab_forecast.errors import ForecastError  # noqa: PLC0415

    try:
        with Client(connection.endpoint, connection.token, connection.timeout) as client:
            yield client
    except ForecastError as error:
        fail(f"{error}{_hint(error)}")
    except BrokenPipeError:  # the reader of our output has closed the pipe, as `head` does
        raise
    except (OSError, ValueError) as error:
        fail(str(error))


def _hint(error: "ForecastError") -> str:
    """Return a remedy in brackets, or nothing where there is no obvious one."""
    from cab_forecast.errors import UNREACHABLE, Unauthenticated  # noqa: PLC0415

    if error.reason == UNREACHABLE:
        return " (is a server running there? start one with: cab-forecast serve)"
    if isinstance(error, Unauthenticated):
        return " (give the server's token with --token or CAB_FORECAST_TOKEN)"
    return ""
