"""Forecasts as a table in the terminal."""

from collections.abc import Iterator, Sequence

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest, PredictResponse
from cab_forecast.courses import heading_now, in_words, seen_from
from cab_forecast.forecast import Forecast, Status, Tracking, forecasts, tracking
from cab_forecast.names import model_name, protocol_name, type_name
from cab_forecast.terminal import UNBOUNDED, unfolded

_HORIZONS = (1.0, 3.0, 6.0)
_MOST_MODES = 3
"""Modes of an agent that are shown, each in a row; the others share one."""
_SMALLEST_WEIGHT = 0.05
"""Modes of less weight are among the others, but for the likeliest."""
_OTHERS = "other ways"
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
    """Prints, per agent, the status and the likely modes; then where the answer came from.

    Args:
        response: what the server said.
        request: what it was asked; tells the agents' types, and where they are and look, without which
            positions are those in the ground frame.
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
    agents = {agent.id: agent for agent in request.agents} if request is not None else {}
    where = "m ahead and to the left of where it is now" if agents else "x, y in m, ground frame"
    table = Table(
        title=f"What each agent does, and how probably; {where}; half-axes of 1 σ in m",
        title_justify="left",
        title_style="bold",
        box=None,
        padding=(0, 2, 0, 0),
    )
    table.add_column("agent", overflow="fold")
    if agents:
        table.add_column("type")
    table.add_column("status")
    table.add_column("prob.", justify="right")
    if agents:
        table.add_column("does")
    for step in steps:
        table.add_column(f"in {_seconds(step, response)}", justify="right", no_wrap=True)
    if steps:
        table.add_column(f"σ in {_seconds(steps[-1], response)}", justify="right", no_wrap=True)
    for view in views:
        agent = agents.get(view.agent_id)
        head = [escape(view.agent_id)]
        if agents:
            head.append(type_name(agent.type) if agent is not None else "")
        head.append(f"[{_STYLES[view.status]}]{view.status}[/]")
        for cells in _modes(view, agent, steps, response.step, told=bool(agents)):
            table.add_row(*head, *cells)
            head = [""] * len(head)
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


def _modes(
    view: Forecast, agent: Agent | None, steps: Sequence[int], step: float, told: bool
) -> Iterator[list[str]]:
    """The cells of an agent's rows: its likely modes, the likeliest first, then what the others weigh.

    Args:
        view: of the agent.
        agent: as the server was told of it; None: unknown.
        steps: indices of those to show.
        step: s between two.
        told: whether the rows say what the agent does.
    """
    if not len(view.weights):
        yield ["–"] * (1 + told + len(steps) + bool(steps))
        return
    ranked = view.ranked_modes
    likely = view.weights[ranked] >= _SMALLEST_WEIGHT
    likely[0] = True
    shown = ranked[likely][:_MOST_MODES]
    percents = _percents([*view.weights[shown], 1.0 - view.weights[shown].sum()])
    for mode, percent in zip(shown.tolist(), percents, strict=False):
        yield [f"{percent} %", *_mode(view, mode, agent, steps, step, told)]
    if percents[-1]:
        empty = [""] * (told + len(steps) + bool(steps))
        yield [f"{percents[-1]} %", *[_OTHERS, *empty][: len(empty)]]


def _mode(
    view: Forecast, mode: int, agent: Agent | None, steps: Sequence[int], step: float, told: bool
) -> list[str]:
    """What the agent does in a mode, where it is at the steps, and how far it spreads at the last."""
    path, does = view.means[mode], ""
    heading = heading_now(agent) if agent is not None and agent.states else None
    if agent is not None and heading is not None:
        path = seen_from(agent, heading, path)
        does = in_words(path, step)
        # Zero is added, for less than 5 cm backwards must not read -0.0
        positions = [f"{ahead:.1f}, {left:+.1f}" for ahead, left in path[list(steps)].round(1) + 0.0]
    else:
        does = "heading unknown: x, y"
        positions = [f"{x:.1f}, {y:.1f}" for x, y in path[list(steps)].round(1) + 0.0]
    cells = [does] * told + positions
    if steps:
        # Half the axes of the 1-σ ellipse, the longer first; rounding may leave a variance just below zero.
        variances = np.linalg.eigvalsh(view.covariances[mode, steps[-1]]).clip(min=0.0)
        minor, major = np.sqrt(variances)
        cells.append(f"{major:.1f} × {minor:.1f}")
    return cells


def _percents(shares: Sequence[float]) -> list[int]:
    """Shares that sum to 1 as whole per cent that sum to 100: the largest remainders are rounded up."""
    exact = 100.0 * np.clip(shares, 0.0, None)
    percents = np.floor(exact + 1e-9)
    missing = round(100.0 - float(percents.sum()))
    for place in np.argsort(percents - exact, kind="stable")[: max(missing, 0)]:
        percents[place] += 1
    return [int(percent) for percent in percents]


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
