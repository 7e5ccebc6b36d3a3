"""Options that commands share."""

from typing import Annotated

import typer

Endpoint = Annotated[
    str, typer.Option(envvar="CAB_FORECAST_ENDPOINT", help="grpc://, grpcs://, http:// or https://")
]
Token = Annotated[str | None, typer.Option(envvar="CAB_FORECAST_TOKEN", help="Bearer token of the server.")]
Timeout = Annotated[float, typer.Option(help="Seconds to wait, retries included.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the answer as JSON, not as a table.")]

DEFAULT_TIMEOUT = 5.0
