# ruff: noqa: PLC0415 - imports are inside, as in all commands: --help must not wait for them
"""``cab-forecast consistency``: how stable and how right a server's forecasts were."""

from typing import Annotated

import typer

from cab_forecast.endpoints import DEFAULT_ENDPOINT
from cli.options import DEFAULT_TIMEOUT, AsJson, Endpoint, Timeout, Token

Scene = Annotated[str, typer.Argument(metavar="SCENE", help="The scene_id of the requests.")]


def register(app: typer.Typer) -> None:
    """Adds the commands."""
    group = typer.Typer(
        help="How stable and how right forecasts were, from what a server remembers.", no_args_is_help=True
    )
    for command in (models, scene, agent, watch, reset):
        group.command()(command)
    app.add_typer(group, name="consistency")


def models(
    *,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    token: Token = None,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Show what was settled of each model since the server started."""
    from cli.asking import Server
    from cli.consistencies import show_models

    show_models(Server(endpoint, token, timeout), as_json)


def scene(
    scene_id: Scene,
    *,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    token: Token = None,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Show the newest observation of every agent of a scene, and sums by model."""
    from cli.asking import Server
    from cli.consistencies import show_scene

    show_scene(Server(endpoint, token, timeout), scene_id, as_json)


def agent(
    scene_id: Scene,
    agent_id: Annotated[str, typer.Argument(metavar="AGENT", help="The agent's id in the requests.")],
    *,
    window: Annotated[
        float | None, typer.Option(help="Seconds back from its newest observation. [default: 2]")
    ] = None,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    token: Token = None,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Show an agent's last observations, and what was forecast for them."""
    from cli.asking import Server
    from cli.consistencies import show_agent

    show_agent(Server(endpoint, token, timeout), scene_id, agent_id, window, as_json)


def watch(
    scene_id: Scene,
    *,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    token: Token = None,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Print what is found out about a scene as it comes, until Ctrl-C or the server's end."""
    from cli.asking import Server
    from cli.consistencies import show_events

    show_events(Server(endpoint, token, timeout), scene_id, as_json)


def reset(
    scene_id: Scene,
    *,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    token: Token = None,
    timeout: Timeout = DEFAULT_TIMEOUT,
    as_json: AsJson = False,
) -> None:
    """Make the server forget a scene."""
    from cli.asking import Server
    from cli.consistencies import reset_scene

    reset_scene(Server(endpoint, token, timeout), scene_id, as_json)
