"""What ``cab-forecast consistency`` does: ask, show."""

from contextlib import suppress

import typer

from cab.forecast.v1.consistency_service_pb2 import (
    GetAgentConsistencyResponse,
    ListModelConsistencyResponse,
    ResetSceneResponse,
)
from cab_forecast.show_consistency import print_event, print_instants, print_models, print_scene
from cli.asking import Server, asking
from cli.messages import to_json

# All of them end with code 1 and one line on standard error when there is no answer.


def show_models(server: Server, as_json: bool) -> None:
    """What was settled of each model."""
    with asking(server) as client:
        models = client.model_consistency()
    if as_json:
        typer.echo(to_json(ListModelConsistencyResponse(models=models)))
    else:
        print_models(models)


def show_scene(server: Server, scene_id: str, as_json: bool) -> None:
    """A scene now."""
    with asking(server) as client:
        response = client.scene_consistency(scene_id)
    if as_json:
        typer.echo(to_json(response))
    else:
        print_scene(response)


def show_agent(server: Server, scene_id: str, agent_id: str, window: float | None, as_json: bool) -> None:
    """An agent's last seconds.

    Args:
        server: whom to ask.
        scene_id: of the requests.
        agent_id: in them.
        window: s; None: the server's default.
        as_json: the answer as JSON.
    """
    with asking(server) as client:
        instants = client.agent_consistency(scene_id, agent_id, window)
    if as_json:
        typer.echo(to_json(GetAgentConsistencyResponse(instants=instants)))
    else:
        print_instants(instants)


def show_events(server: Server, scene_id: str, as_json: bool) -> None:
    """A scene from now on, until Ctrl-C or until the server ends it."""
    with suppress(KeyboardInterrupt), asking(server) as client, client.watch_scene(scene_id) as events:
        for event in events:
            if as_json:
                typer.echo(to_json(event))
            else:
                print_event(event)
        typer.echo("the server ended the watch", err=True)


def reset_scene(server: Server, scene_id: str, as_json: bool) -> None:
    """Forgets a scene."""
    with asking(server) as client:
        agents = client.reset_scene(scene_id)
    if as_json:
        typer.echo(to_json(ResetSceneResponse(agents=agents)))
    else:
        typer.echo(f"forgot {agents} agents" if agents else "there was nothing to forget")
