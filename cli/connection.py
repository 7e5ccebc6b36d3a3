"""The options and errors shared by commands that call a server."""

import functools
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cab_forecast.endpoints import DEFAULT_ENDPOINT
from cli.failures import fail

if TYPE_CHECKING:
    from cab_forecast.client import Client
    from cab_forecast.errors import ForecastError

Timeout = Annotated[float, typer.Option(help="Seconds per call, retries included.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the response as JSON instead of a table.")]

DEFAULT_TIMEOUT = 5.0


@dataclass(frozen=True)
class Connection:
    """A server, and what callers prove to it. The fields are options of every command that calls one."""

    endpoint: Annotated[
        str, typer.Option(envvar="CAB_FORECAST_ENDPOINT", help="grpc://, grpcs://, http:// or https://")
    ] = DEFAULT_ENDPOINT
    token: Annotated[
        str | None,
        typer.Option("--token", "--api-key", envvar="CAB_FORECAST_TOKEN", help="API key or bearer token."),
    ] = None
    ca_file: Annotated[
        Path | None,
        typer.Option(
            envvar="CAB_FORECAST_CA_FILE", help="PEM certificates to trust instead of the system's."
        ),
    ] = None
    certificate_file: Annotated[
        Path | None,
        typer.Option(
            envvar="CAB_FORECAST_CERTIFICATE_FILE",
            help="PEM certificate to present to servers that require one.",
        ),
    ] = None
    key_file: Annotated[
        Path | None, typer.Option(envvar="CAB_FORECAST_KEY_FILE", help="PEM private key of that certificate.")
    ] = None


def with_connection(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of ``Connection`` in place of its argument ``connection``."""
    options = inspect.signature(Connection, eval_str=True).parameters.values()

    @functools.wraps(command)
    def with_options(**arguments: Any) -> None:
        chosen = {option.name: arguments.pop(option.name) for option in options}
        command(connection=Connection(**chosen), **arguments)

    own = [each for name, each in inspect.signature(command).parameters.items() if name != "connection"]
    added = [option.replace(kind=inspect.Parameter.KEYWORD_ONLY) for option in options]
    parameters = sorted([*own, *added], key=lambda each: each.kind)
    # typer reads both
    with_options.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    with_options.__annotations__ = {each.name: each.annotation for each in parameters}
    return with_options


@contextmanager
def connect(connection: Connection, timeout: float, retries: int | None = None) -> Iterator["Client"]:
    """Open a client; turn its errors into one line on standard error.

    Args:
        connection: the server.
        timeout: seconds per call, retries included.
        retries: max number of retries of a call; None: the client's default.

    Raises:
        typer.Exit: with code 1, when a call fails.
    """
    from cab_forecast.client import Client  # noqa: PLC0415
    from cab_forecast.connection import DEFAULT_RETRIES  # noqa: PLC0415
    from cab_forecast.errors import ForecastError  # noqa: PLC0415

    try:
        with Client(
            connection.endpoint,
            connection.token,
            timeout,
            DEFAULT_RETRIES if retries is None else retries,
            ca_file=connection.ca_file,
            certificate_file=connection.certificate_file,
            key_file=connection.key_file,
        ) as client:
            yield client
    except ForecastError as error:
        fail(f"{error}{_hint(error)}")
    except BrokenPipeError:  # the reader of our output has closed the pipe, as `head` does
        raise
    except (OSError, ValueError) as error:
        fail(str(error))


def _hint(error: "ForecastError") -> str:
    """Return a remedy in brackets, or nothing where there is no obvious one."""
    from cab_forecast.errors import UNREACHABLE, Unauthenticated, Untrusted  # noqa: PLC0415

    if error.reason == UNREACHABLE:
        return " (is a server running there? start one with: cab-forecast serve)"
    if isinstance(error, Unauthenticated):
        return " (give the server's key with --token or CAB_FORECAST_TOKEN)"
    if isinstance(error, Untrusted):
        return " (name its authority with --ca-file or CAB_FORECAST_CA_FILE)"
    return ""
