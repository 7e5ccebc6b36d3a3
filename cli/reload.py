"""``cab-forecast reload``: make a server read its folder of models again."""

from typing import TYPE_CHECKING, Annotated

import typer

from cli.connection import AsJson, Connection, connect, with_connection

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cab.forecast.v1.model_service_pb2 import ModelReference

_TIMEOUT = 120.0


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("reload")(with_connection(reload))


def reload(
    *,
    connection: Connection,
    timeout: Annotated[
        float, typer.Option(help="Seconds to wait; the server goes on afterwards.")
    ] = _TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Make a server read its folder of models again.

    New checkpoints are checked and warmed up before they take over. The exit code is 1 if one was refused.
    """
    from cli.messages import to_json  # noqa: PLC0415

    with connect(connection, timeout) as client:
        response = client.reload_models()
    if as_json:
        typer.echo(to_json(response))
    else:
        _print("loaded", response.loaded)
        _print("dropped", response.dropped)
        for refused in response.refused:
            typer.secho(f"refused: {refused.folder}: {refused.reason}", fg=typer.colors.RED)
        _print("default", [response.default_model])
    if response.refused:
        raise typer.Exit(1)


def _print(what: str, models: "Iterable[ModelReference]") -> None:
    names = ", ".join(f"{model.name}@{model.version}" for model in models)
    typer.echo(f"{what}: {names or 'none'}")
