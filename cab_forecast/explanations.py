"""Explanations of forecasts: requests for them, and tables of them in the terminal."""

from collections.abc import Iterable
from typing import Literal, get_args

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cab.forecast.v1.explanation_service_pb2 import (
    EXPLANATION_BASELINE_DONORS,
    EXPLANATION_BASELINE_NULL_CONTEXT,
    EXPLANATION_BASELINE_UNSPECIFIED,
    AgentExplanation,
    ExplainOptions,
    ExplainRequest,
    ExplainResponse,
    ShapleyValue,
)
from cab.forecast.v1.prediction_service_pb2 import (
    FORECAST_STATUS_INVALID,
    FORECAST_STATUS_OK,
    Agent,
    ForecastStatus,
    PredictRequest,
    SceneRaster,
)
from cab_forecast.forecast import model_name, protocol_name

Baseline = Literal["donors", "null_context"]

PARTS = ("state", "map", "neighbors")
"""Fields of the three players of an explanation."""
_SHOWN_NEIGHBORS = 5


def explain_options(
    *,
    baseline: Baseline = "donors",
    by_neighbor: bool = False,
    draws: int = 0,
    permutations: int = 0,
    seed: int = 0,
    horizon: float | None = None,
) -> ExplainOptions:
    """Build the options of a request to explain forecasts.

    Args:
        baseline: what stands for absent parts: ``donors`` (parts of other agents, if the server has some), or
            ``null_context`` (an unknown map, no neighbours, an agent that stands still).
        by_neighbor: whether to return the value of each neighbour.
        draws: number of donors drawn for an agent, 2 to 32; 0: the server's default.
        permutations: number of orders drawn where an agent has more than six neighbours, even, 4 to 256;
            0: the server's default.
        seed: seed of the draws.
        horizon: seconds until the end point, a multiple of 0.5; None: the model's horizon.

    Raises:
        ValueError: a count or seed is negative or exceeds 32 bits, or the baseline is unknown.
    """
    if baseline not in get_args(Baseline):
        raise ValueError(f"baseline must be one of {', '.join(get_args(Baseline))}, not {baseline!r}")
    null_context = baseline == "null_context"
    return ExplainOptions(
        # Unspecified are donors, or the null context where the server has none
        baseline=EXPLANATION_BASELINE_NULL_CONTEXT if null_context else EXPLANATION_BASELINE_UNSPECIFIED,
        draws=draws,
        by_neighbor=by_neighbor,
        permutations=permutations,
        seed=seed,
        horizon=horizon,
    )


def explain_request(
    time: float,
    agents: Iterable[Agent],
    *,
    model: str = "",
    raster: SceneRaster | None = None,
    options: ExplainOptions | None = None,
) -> ExplainRequest:
    """Build a request to explain forecasts of agents of one scene.

    Args:
        time: the present, seconds since the epoch.
        agents: the agents, see ``cab_forecast.agent``; those with ``predict`` are explained.
        model: ``name`` or ``name@version``; empty: the server's default.
        raster: map of the scene, see ``cab_forecast.scene_raster``.
        options: see ``explain_options``; None: the defaults.
    """
    return ExplainRequest(time=time, agents=agents, model=model, scene_raster=raster, options=options)


def as_explain_request(request: PredictRequest, options: ExplainOptions | None = None) -> ExplainRequest:
    """Build a request to explain the forecasts that another request asks for, of the same scene and model.

    Args:
        request: the other request.
        options: the options; None: the defaults, with the horizon of the other request.
    """
    explain = ExplainRequest(model=request.model, agents=request.agents)
    if request.HasField("time"):
        explain.time = request.time
    if request.HasField("scene_raster"):
        explain.scene_raster.CopyFrom(request.scene_raster)
    if options is not None:
        explain.options.CopyFrom(options)
    elif request.options.HasField("horizon"):
        explain.options.horizon = request.options.horizon
    return explain


def print_explanations(response: ExplainResponse, console: Console | None = None) -> None:
    """Print the Shapley values of each agent, and those of the neighbours that matter most.

    Args:
        response: the response.
        console: the console; None: standard output.
    """
    console = console or Console()
    title = f"What brings the most likely end point at {response.horizon:g} s nearer to where it is; m"
    table = Table(title=title, title_justify="left", title_style="bold", header_style="bold", box=None)
    table.add_column("agent", no_wrap=True)
    for heading in ("state", "map", "neighbours", "all", "absent is"):
        table.add_column(heading, justify="right" if heading != "absent is" else "left", no_wrap=True)
    for one in response.explanations:
        if one.status == FORECAST_STATUS_INVALID:
            table.add_row(escape(one.agent_id), "–", "–", "–", "–", "")
            continue
        values = [getattr(one, part) for part in PARTS]
        total = sum(value.nearer for value in values)
        table.add_row(escape(one.agent_id), *map(_cell, values), f"{total:+.2f}", _absent(one))
        for neighbor in one.by_neighbor[:_SHOWN_NEIGHBORS]:
            if not neighbor.value.nearer:
                break  # the others cannot be seen
            table.add_row(f"[dim]  {escape(neighbor.agent_id)}[/]", "", "", _cell(neighbor.value), "", "")
    console.print(table)
    for one in response.explanations:
        if one.status != FORECAST_STATUS_OK:
            name = ForecastStatus.Name(one.status).removeprefix("FORECAST_STATUS_")
            console.print(f"{escape(one.agent_id)}: {name}: {escape(one.detail)}", highlight=False)
    model = response.model
    origin = f"{model_name(model)}, {protocol_name(model.protocol)} protocol, {response.forecasts} forecasts"
    console.print(f"[dim]{escape(origin)}[/]", highlight=False)
    for warning in response.warnings:
        console.print(f"[yellow]warning: {escape(warning)}[/]", highlight=False, soft_wrap=True)


def _cell(value: ShapleyValue) -> str:
    error = f" ± {value.nearer_error:.2f}" if value.nearer_error else ""
    return f"{value.nearer:+.2f}{error}"


def _absent(one: AgentExplanation) -> str:
    if one.baseline == EXPLANATION_BASELINE_DONORS:
        return f"{one.draws} donors"
    return "null context"
