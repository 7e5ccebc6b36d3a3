# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for them
"""``cab-forecast scenes``: the scenes that a server is forecasting."""

import typer

from cli.connection import DEFAULT_TIMEOUT, AsJson, Connection, Timeout, connect, with_connection


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(with_connection(scenes))


def scenes(*, connection: Connection, timeout: Timeout = DEFAULT_TIMEOUT, as_json: AsJson = False) -> None:
    """List the live scenes: how often each is called, for how many agents, and with which model."""
    from cab.forecast.v1.scene_service_pb2 import ListScenesResponse
    from cab_forecast.show import print_scenes
    from cli.messages import to_json

    with connect(connection, timeout) as client:
        listed = client.list_scenes()
    if as_json:
        typer.echo(to_json(ListScenesResponse(scenes=listed)))
    else:
        print_scenes(listed)
