# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for them
"""``cab-forecast explain``: what forecasts of a running server owe to own state, map and neighbours."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cab.forecast.v1.bounds import MAX_DRAWS, MAX_PERMUTATIONS
from cli.connection import AsJson, Connection, Timeout, connect, with_connection
from cli.failures import fail
from cli.predict import DEMO, UINT32_MAX, Horizon, RequestFile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cab.forecast.v1.prediction_service_pb2 import PredictRequest

_TIMEOUT = 60.0


class AbsentPart(StrEnum):
    """Stand-in for a part that is absent."""

    DONORS = "donors"
    NULL_CONTEXT = "null-context"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(name="explain")(with_connection(explain))


def explain(
    request_file: RequestFile,
    *,
    connection: Connection,
    timeout: Timeout = _TIMEOUT,
    models: Annotated[
        str | None, typer.Option("--model", help="NAME[@VERSION],… to explain, one after the other.")
    ] = None,
    agents: Annotated[
        list[str] | None,
        typer.Option("--agent", help="Id of an agent to explain, repeatable. [default: all]"),
    ] = None,
    baseline: Annotated[AbsentPart, typer.Option(help="What stands for what is absent.")] = AbsentPart.DONORS,
    by_neighbor: Annotated[
        bool, typer.Option("--by-neighbor", help="Also show the neighbours that matter most.")
    ] = False,
    draws: Annotated[int, typer.Option(min=0, max=MAX_DRAWS, help="Donors for each agent; 0: 8.")] = 0,
    permutations: Annotated[
        int,
        typer.Option(min=0, max=MAX_PERMUTATIONS, help="Orders of more than six neighbours, even; 0: 16."),
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, max=UINT32_MAX, help="Seed of the draws.")] = 0,
    horizon: Horizon = None,
    plot: Annotated[
        Path | None,
        typer.Option(dir_okay=False, help="Plot bars beside the forecasts to a .png, .svg or .pdf file."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what forecasts owe to own state, map and neighbours, by Shapley values."""
    from cab.forecast.v1.prediction_service_pb2 import PredictRequest
    from cab_forecast.demo import demo_request
    from cab_forecast.explanations import as_explain_request, explain_options, print_explanations
    from cli.messages import read_message, to_json

    try:
        request = demo_request() if request_file == DEMO else read_message(request_file, PredictRequest())
        _select(request, agents or [])
        options = explain_options(
            baseline="donors" if baseline is AbsentPart.DONORS else "null_context",
            by_neighbor=by_neighbor,
            draws=draws,
            permutations=permutations,
            seed=seed,
            horizon=horizon,
        )
        if plot is not None:
            import cab_forecast.plot  # noqa: F401 (an optional extra)
        names = [name.strip() for name in (models or request.model).split(",")]
        answers = []
        with connect(connection, timeout) as client:
            for name in names:
                request.model = name
                answer = client.explain(as_explain_request(request, options))
                if as_json:
                    typer.echo(to_json(answer))
                else:
                    print_explanations(answer)
                answers.append((answer, client.predict(request) if plot is not None else None))
        if plot is not None:
            from cab_forecast.explain_plot import Explained, plot_explanations

            row = [Explained(request, shown, answer) for answer, shown in answers if shown is not None]
            plot_explanations([row], plot)
    except (OSError, ValueError, ModuleNotFoundError) as error:
        fail(str(error))


def _select(request: "PredictRequest", agents: "Sequence[str]") -> None:
    """Let only these agents be explained; none given: those that the request asks for.

    Raises:
        ValueError: the request has no agent of that id.
    """
    if not agents:
        return
    unknown = set(agents) - {agent.id for agent in request.agents}
    if unknown:
        raise ValueError(f"the request has no agent {', '.join(sorted(unknown))}")
    for agent in request.agents:
        agent.predict = agent.id in agents
