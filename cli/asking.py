"""Calls of commands to a server: an answer, or one line that says why there is none."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from cab_forecast.client import Client
from cab_forecast.errors import UNREACHABLE, ForecastError, Unauthenticated
from cli.failures import fail


@dataclass(frozen=True)
class Server:
    """Whom to ask."""

    endpoint: str
    token: str | None
    timeout: float
    """s."""


@contextmanager
def asking(server: Server) -> Iterator[Client]:
    """A client of the server.

    Raises:
        typer.Exit: with code 1 and one line on standard error, when there is no answer.
    """
    try:
        with Client(server.endpoint, server.token, server.timeout) as client:
            yield client
    except ForecastError as error:
        fail(f"{error}{_hint(error)}")
    except BrokenPipeError:  # whoever read what is printed has seen enough
        raise
    except (OSError, ValueError) as error:
        fail(str(error))


def _hint(error: ForecastError) -> str:
    """What to do about it, where that is plain."""
    if error.reason == UNREACHABLE:
        return " (is a server running there? start one with: cab-forecast serve)"
    if isinstance(error, Unauthenticated):
        return " (give the server's token with --token or CAB_FORECAST_TOKEN)"
    return ""
