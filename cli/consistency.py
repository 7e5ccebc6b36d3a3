# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for them
"""``cab-forecast consistency``: stability and accuracy of the forecasts that a server remembers."""

from contextlib import suppress
from typing import Annotated

import typer

from cli.connection import DEFAULT_TIMEOUT, AsJson, Connection, Timeout, connect, with_connection

Scene = Annotated[str, typer.Argument(metavar="SCENE", help="The scene_id of the requests.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(
        help="Show how stable and how accurate a server's recent forecasts were.", no_args_is_help=True
    )
    for command in (models, scene, agent, watch, reset):
        group.command()(with_connection(command))
    app.add_typer(group, name="consistency")


def models(
    *,
    connection: Connection,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Show each model's metrics since the server started."""
    from cab.forecast.v1.consistency_service_pb2 import ListModelConsistencyResponse
    from cab_forecast.show import print_models
    from cli.messages import to_json

    with connect(connection, timeout) as client:
        listed = client.model_consistency()
    if as_json:
        typer.echo(to_json(ListModelConsistencyResponse(models=listed)))
    else:
        print_models(listed)


def scene(
    scene_id: Scene,
    *,
    connection: Connection,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Show the latest observation of every agent of a scene, and sums by model."""
    from cab_forecast.show import print_scene
    from cli.messages import to_json

    with connect(connection, timeout) as client:
        response = client.scene_consistency(scene_id)
    if as_json:
        typer.echo(to_json(response))
    else:
        print_scene(response)


def agent(
    scene_id: Scene,
    agent_id: Annotated[str, typer.Argument(metavar="AGENT", help="The agent's id in the requests.")],
    *,
    window: Annotated[
        float | None, typer.Option(help="Seconds back from the agent's latest observation. [default: 2]")
    ] = None,
    connection: Connection,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Show an agent's latest observations, and what was forecast for them."""
    from cab.forecast.v1.consistency_service_pb2 import GetAgentConsistencyResponse
    from cab_forecast.show import print_instants
    from cli.messages import to_json

    with connect(connection, timeout) as client:
        instants = client.agent_consistency(scene_id, agent_id, window)
    if as_json:
        typer.echo(to_json(GetAgentConsistencyResponse(instants=instants)))
    else:
        print_instants(instants)


def watch(
    scene_id: Scene,
    *,
    connection: Connection,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Print a scene's metrics as they are settled, until Ctrl-C or until the server ends the stream."""
    from cab_forecast.show import print_event
    from cli.messages import to_json

    with (
        suppress(KeyboardInterrupt),
        connect(connection, timeout) as client,
        client.watch_scene(scene_id) as events,
    ):
        for event in events:
            if as_json:
                typer.echo(to_json(event))
            else:
                print_event(event)
        typer.echo("the server ended the watch", err=True)


def reset(
    scene_id: Scene,
    *,
    connection: Connection,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Make the server forget a scene."""
    from cab.forecast.v1.consistency_service_pb2 import ResetSceneResponse
    from cli.messages import to_json

    with connect(connection, timeout) as client:
        agents = client.reset_scene(scene_id)
    if as_json:
        typer.echo(to_json(ResetSceneResponse(agents=agents)))
    else:
        typer.echo(f"forgot {agents} agents" if agents else "there was nothing to forget")
