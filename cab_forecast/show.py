"""Forecasts as a table in the terminal."""

from collections.abc import Iterator, Sequence

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse
from cab_forecast.forecast import Forecast, Status, Tracking, forecasts, tracking
from cab_forecast.names import model_name, protocol_name, type_name
from cab_forecast.terminal import UNBOUNDED, unfolded

_HORIZONS = (1.0, 3.0, 6.0)
_STYLES = {
    Status.UNSPECIFIED: "magenta",
    Status.OK: "green",
    Status.SHORT_HISTORY: "yellow",
    Status.FALLBACK: "yellow",
    Status.INVALID: "bold red",
}


def print_forecasts(
    response: PredictResponse, request: PredictRequest | None = None, console: Console | None = None
) -> None:
    """Prints, per agent, the status and the likeliest mode; then where the answer came from.

    Args:
        response: what the server said.
        request: what it was asked; tells the agents' types.
        console: where to print; None: standard output.

    Raises:
        ValueError: sizes in the response contradict each other.
    """
    console = unfolded(console)
    views = list(forecasts(response).values())
    console.print(_fitting_table(views, response, request, console))
    for view in views:
        if view.status is not Status.OK:
            console.print(_note(view, response), highlight=False, soft_wrap=True)
    console.print(f"[dim]{escape(_origin(response))}[/]", highlight=False, soft_wrap=True)
    for warning in (*response.warnings, *_memory_warnings(response, views)):
        console.print(f"[yellow]warning: {escape(warning)}[/]", highlight=False, soft_wrap=True)


def _memory_warnings(response: PredictResponse, views: Sequence[Forecast]) -> Iterator[str]:
    """What a user must know of the track memory."""
    if tracking(response) is Tracking.UNAVAILABLE:
        yield "the track memory did not answer in time: nothing was recalled"
    if tracking(response) is Tracking.RESET:
        yield "what the server remembered of the scene is gone"
    again = [view.agent_id for view in views if view.tracking is Tracking.RESET]
    if again:
        yield f"what was remembered did not fit, and begins anew: {', '.join(again)}"


def _fitting_table(
    views: Sequence[Forecast], response: PredictResponse, request: PredictRequest | None, console: Console
) -> Table:
    """A table that the terminal is wide enough for; the earliest steps go first."""
    steps = _steps(response)
    table = _table(views, response, request, steps)
    while _width(table, console) > console.width and len(steps) > 1:
        steps = steps[1:]
        table = _table(views, response, request, steps)
    return table


def _width(table: Table, console: Console) -> int:
    """Columns that the table takes unfolded."""
    return Measurement.get(console, console.options.update(width=UNBOUNDED), table).maximum


def _table(
    views: Sequence[Forecast],
    response: PredictResponse,
    request: PredictRequest | None,
    steps: Sequence[int],
) -> Table:
    types = {agent.id: type_name(agent.type) for agent in request.agents} if request is not None else {}
    table = Table(
        title="Likeliest mode of each agent: x, y and 1-σ half-axes in m, ground frame",
        title_justify="left",
        title_style="bold",
        box=None,
        padding=(0, 2, 0, 0),
    )
    table.add_column("agent", overflow="fold")
    if types:
        table.add_column("type")
    table.add_column("status")
    table.add_column("weight", justify="right")
    for step in steps:
        table.add_column(f"in {_seconds(step, response)}", justify="right", no_wrap=True)
    if steps:
        table.add_column(f"σ in {_seconds(steps[-1], response)}", justify="right", no_wrap=True)
    for view in views:
        cells = [escape(view.agent_id)]
        if types:
            cells.append(types.get(view.agent_id, ""))
        table.add_row(*cells, f"[{_STYLES[view.status]}]{view.status}[/]", *_mode(view, steps))
    return table


def _steps(response: PredictResponse) -> list[int]:
    """Indices of the steps to show: those nearest to the horizons that the forecast reaches, and its last."""
    if not response.steps:
        return []
    last = response.steps - 1
    chosen = {round(seconds / response.step) - 1 for seconds in _HORIZONS} if response.step > 0 else set()
    return sorted({step for step in chosen if 0 <= step < last} | {last})


def _seconds(step: int, response: PredictResponse) -> str:
    return f"{(step + 1) * response.step:g} s"


def _note(view: Forecast, response: PredictResponse) -> str:
    """Why an agent's status is not OK, and which model stepped in."""
    other = view.model.name and view.model != response.model and view.model.name not in view.detail
    used = f" by {model_name(view.model)}" if other else ""
    detail = f"{view.field}: {view.detail}" if view.field not in view.detail else view.detail
    return (
        f"[{_STYLES[view.status]}]{escape(view.agent_id)}: {view.status}{escape(used)}[/]: {escape(detail)}"
    )


def _mode(view: Forecast, steps: Sequence[int]) -> list[str]:
    if not len(view.weights):
        return ["–"] * (len(steps) + 2)
    mode = view.most_likely_mode
    positions = [f"{x:.1f}, {y:.1f}" for x, y in view.most_likely[list(steps)]]
    # Half the axes of the 1-σ ellipse, the longer first; rounding may leave a variance just below zero.
    variances = np.linalg.eigvalsh(view.covariances[mode, steps[-1]]).clip(min=0.0)
    minor, major = np.sqrt(variances)
    weight = f"{view.weights[mode]:.2f} of {len(view.weights)}"
    return [weight, *positions, f"{major:.1f} × {minor:.1f}"]


def _origin(response: PredictResponse) -> str:
    timing = response.timing
    parts = [
        f"model {model_name(response.model)}",
        f"protocol {protocol_name(response.model.protocol)}",
        f"queue {timing.queue * 1e3:.1f} ms",
        f"inference {timing.inference * 1e3:.1f} ms",
        f"batch of {timing.batch_agents} agents",
    ]
    if response.tracking:
        parts.append(f"track memory {tracking(response).lower()}, {timing.tracking * 1e3:.1f} ms")
    return " · ".join(parts)
