"""Forecasts and consistency as tables in the terminal."""

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from cab.forecast.v1.consistency_service_pb2 import (
    GetSceneConsistencyResponse,
    InstantConsistency,
    ModelConsistency,
    Summary,
    WatchSceneResponse,
)
from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest, PredictResponse
from cab.forecast.v1.scene_service_pb2 import SceneSummary
from cab_forecast.forecast import (
    Forecast,
    Status,
    Tracking,
    forecasts,
    model_name,
    protocol_name,
    tracking,
    type_name,
)
from cab_forecast.maneuvers import current_heading, describe_maneuver, to_agent_frame

_UNBOUNDED = 10_000
"""Columns; wider than any table."""
_HORIZONS = (1.0, 3.0, 6.0)
"""Seconds ahead at which positions are shown."""
_MAX_MODES = 3
"""Max number of modes of an agent that have a row each; the others share one."""
_MIN_WEIGHT = 0.05
"""Min weight of a mode to have its own row; the most likely mode always has one."""
_OTHERS = "other modes"
_AGES = (1.0, 3.0, 6.0)
"""Forecast ages, s, whose errors are shown."""
_RANGES = (0.2, 1.0, 5.0)
"""Ranges of the convergence-to-range, m."""
_NOTHING = "–"
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
    """Print the status and the most likely modes of each agent, then model and timing.

    Args:
        response: the response.
        request: its request, for the agents' types and poses; None: positions are in the ground frame.
        console: the console; None: standard output.

    Raises:
        ValueError: sizes in the response contradict each other.
    """
    console = _wide(console)
    views = list(forecasts(response).values())
    console.print(_fitting_table(views, response, request, console))
    for view in views:
        if view.status is not Status.OK:
            console.print(_note(view, response), highlight=False, soft_wrap=True)
    console.print(f"[dim]{escape(_origin(response))}[/]", highlight=False, soft_wrap=True)
    for warning in (*response.warnings, *_input_warnings(views), *_memory_warnings(response, views)):
        console.print(f"[yellow]warning: {escape(warning)}[/]", highlight=False, soft_wrap=True)


def print_instants(
    instants: Sequence[InstantConsistency], title: str = "Observations", console: Console | None = None
) -> None:
    """Print observations of agents, with the consistency of their forecasts.

    Args:
        instants: the observations, in the order to print.
        title: title of the table; units are appended.
        console: the console; None: standard output.
    """
    console = _wide(console)
    if not instants:
        console.print("[dim]no forecast has been observed yet[/]")
        return
    table = _left_table(
        f"{title}: time in s, distances in m, C(range) in s", "agent", "time", "model", "forecasts"
    )
    for heading in _metric_headings():
        table.add_column(heading, justify="right", no_wrap=True)
    for instant in instants:
        table.add_row(*_instant_cells(instant))
    console.print(table)


def print_models(models: Sequence[ModelConsistency], console: Console | None = None) -> None:
    """Print the means over the settled forecast sets of each model.

    Args:
        models: the aggregates, in the order to print.
        console: the console; None: standard output.
    """
    console = _wide(console)
    if not models:
        console.print("[dim]no forecasts are settled yet[/]")
        return
    table = _left_table("Settled forecasts: means; distances in m, C(range) in s", "model")
    for heading in ("sets", *_metric_headings()):
        table.add_column(heading, justify="right", no_wrap=True)
    for model in models:
        convergence = {entry.range: entry.duration for entry in model.convergence}
        errors = {entry.age: entry.displacement_error for entry in model.errors}
        means = [model.dispersion_standard_deviation, *map(convergence.get, _RANGES), *map(errors.get, _AGES)]
        table.add_row(escape(model_name(model.model)), str(model.instants), *map(_mean, means))
    console.print(table)


def print_scenes(scenes: Sequence[SceneSummary], console: Console | None = None) -> None:
    """Print the live scenes.

    Args:
        scenes: the scenes, in the order to print.
        console: the console; None: standard output.
    """
    console = _wide(console)
    if not scenes:
        console.print("[dim]no scene was forecast lately[/]")
        return
    table = _left_table("Live scenes", "scene")
    for heading in ("agents", "calls/s", "time, s"):
        table.add_column(heading, justify="right", no_wrap=True)
    for heading in ("last call", "model"):
        table.add_column(heading, no_wrap=True)
    for scene in scenes:
        called = datetime.fromtimestamp(scene.updated_time).strftime("%H:%M:%S")
        numbers = (f"{scene.agents}", f"{scene.rate_hz:.1f}", f"{scene.time:.2f}")
        table.add_row(escape(scene.scene_id), *numbers, called, escape(model_name(scene.model)))
    console.print(table)


def print_scene(response: GetSceneConsistencyResponse, console: Console | None = None) -> None:
    """Print a scene: its agents, then the aggregates by model.

    Args:
        response: the response.
        console: the console; None: standard output.
    """
    console = _wide(console)
    print_instants(response.latest, "Newest observation of each agent", console)
    console.print()
    print_models(response.models, console)


def print_event(event: WatchSceneResponse, console: Console | None = None) -> None:
    """Print an event of a watched scene, one line per observation.

    Args:
        event: the event.
        console: the console; None: standard output.
    """
    console = _wide(console)
    if event.missed:
        console.print(f"[yellow]{event.missed} events were missed[/]", highlight=False)
    for instant in event.instants:
        agent, time, model, forecasts, *metrics = _instant_cells(instant)
        named = [f"{name} {metric}" for name, metric in zip(_metric_headings(), metrics, strict=True)]
        present = [text for text in named if not text.endswith(_NOTHING)]
        line = "  ".join([time, agent, model, forecasts, *present])
        console.print(line, highlight=False, soft_wrap=True)


def _wide(console: Console | None) -> Console:
    """Return a console that does not fold lines unless it is a terminal.

    Args:
        console: the console; None: standard output.
    """
    console = console or Console()
    if console.is_terminal:
        return console
    return Console(file=console.file, width=_UNBOUNDED)  # files and pipes have no width


def _input_warnings(views: Sequence[Forecast]) -> Iterator[str]:
    """Yield the warnings of agents' inputs; one that several agents have in the same words only once."""
    agents: dict[tuple[str, str], list[str]] = {}
    for view in views:
        for warning in view.warnings:
            agents.setdefault((warning.code, warning.detail), []).append(view.agent_id)
    for (code, detail), names in agents.items():
        yield f"{code}: {', '.join(names)}: {detail}"


def _memory_warnings(response: PredictResponse, views: Sequence[Forecast]) -> Iterator[str]:
    """Yield warnings about the track memory."""
    if tracking(response) is Tracking.UNAVAILABLE:
        yield "the track memory did not respond in time: no history was recalled"
    if tracking(response) is Tracking.RESET:
        yield "the server no longer has the tracks of the scene"
    reset = [view.agent_id for view in views if view.tracking is Tracking.RESET]
    if reset:
        yield f"tracks did not fit the request and start anew: {', '.join(reset)}"


def _fitting_table(
    views: Sequence[Forecast], response: PredictResponse, request: PredictRequest | None, console: Console
) -> Table:
    """Return a table that fits the terminal; the earliest steps are dropped first."""
    steps = _steps(response)
    table = _table(views, response, request, steps)
    while _width(table, console) > console.width and len(steps) > 1:
        steps = steps[1:]
        table = _table(views, response, request, steps)
    return table


def _width(table: Table, console: Console) -> int:
    """Return the width of the table without folding, in columns."""
    return Measurement.get(console, console.options.update(width=_UNBOUNDED), table).maximum


def _table(
    views: Sequence[Forecast],
    response: PredictResponse,
    request: PredictRequest | None,
    steps: Sequence[int],
) -> Table:
    agents = {agent.id: agent for agent in request.agents} if request is not None else {}
    where = "m ahead and to the left of the agent" if agents else "x, y in m, ground frame"
    table = Table(
        title=f"Maneuvers and their probabilities; {where}; half-axes of 1 σ in m",
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
        table.add_column("maneuver")
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
        for cells in _modes(view, agent, steps, response.step, described=bool(agents)):
            table.add_row(*head, *cells)
            head = [""] * len(head)
    return table


def _steps(response: PredictResponse) -> list[int]:
    """Return the indices of the steps to show: the nearest to each horizon, and the last one."""
    if not response.steps:
        return []
    last = response.steps - 1
    chosen = {round(seconds / response.step) - 1 for seconds in _HORIZONS} if response.step > 0 else set()
    return sorted({step for step in chosen if 0 <= step < last} | {last})


def _seconds(step: int, response: PredictResponse) -> str:
    return f"{(step + 1) * response.step:g} s"


def _note(view: Forecast, response: PredictResponse) -> str:
    """Return a line of rich markup: the agent, its status, the fallback model, and the reason."""
    other = view.model.name and view.model != response.model and view.model.name not in view.detail
    used = f" by {model_name(view.model)}" if other else ""
    detail = f"{view.field}: {view.detail}" if view.field not in view.detail else view.detail
    return (
        f"[{_STYLES[view.status]}]{escape(view.agent_id)}: {view.status}{escape(used)}[/]: {escape(detail)}"
    )


def _modes(
    view: Forecast, agent: Agent | None, steps: Sequence[int], step: float, described: bool
) -> Iterator[list[str]]:
    """Yield the cells of an agent's rows: its modes by descending weight, then the weight of the others.

    Args:
        view: the agent's forecast.
        agent: the agent in the request; None: unknown.
        steps: indices of the steps to show.
        step: seconds between two steps.
        described: whether the rows describe the maneuver.
    """
    if not len(view.weights):
        yield ["–"] * (1 + described + len(steps) + bool(steps))
        return
    ranked = view.ranked_modes
    likely = view.weights[ranked] >= _MIN_WEIGHT
    likely[0] = True
    shown = ranked[likely][:_MAX_MODES]
    percents = _percents([*view.weights[shown], 1.0 - view.weights[shown].sum()])
    for mode, percent in zip(shown.tolist(), percents, strict=False):
        yield [f"{percent} %", *_mode(view, mode, agent, steps, step, described)]
    if percents[-1]:
        empty = [""] * (described + len(steps) + bool(steps))
        yield [f"{percents[-1]} %", *[_OTHERS, *empty][: len(empty)]]


def _mode(
    view: Forecast, mode: int, agent: Agent | None, steps: Sequence[int], step: float, described: bool
) -> list[str]:
    """Return the cells of a mode: the maneuver, the positions at the steps, and the spread at the last."""
    path = view.means[mode]
    heading = current_heading(agent) if agent is not None and agent.states else None
    if agent is not None and heading is not None:
        path = to_agent_frame(agent, heading, path)
        maneuver = describe_maneuver(path, step)
        # Adding zero turns -0.0 into 0.0.
        positions = [f"{ahead:.1f}, {left:+.1f}" for ahead, left in path[list(steps)].round(1) + 0.0]
    else:
        maneuver = "heading unknown: x, y"
        positions = [f"{x:.1f}, {y:.1f}" for x, y in path[list(steps)].round(1) + 0.0]
    cells = [maneuver] * described + positions
    if steps:
        # Half-axes of the 1-σ ellipse, the longer one first; rounding may leave a variance just below zero.
        variances = np.linalg.eigvalsh(view.covariances[mode, steps[-1]]).clip(min=0.0)
        minor, major = np.sqrt(variances)
        cells.append(f"{major:.1f} × {minor:.1f}")
    return cells


def _percents(shares: Sequence[float]) -> list[int]:
    """Round shares that sum to 1 to whole percents that sum to 100, by the largest-remainder method."""
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


def _left_table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _metric_headings() -> list[str]:
    """Return the headings of the metrics, with which rows of instants and of models end."""
    ranges = [f"C({tau:g} m)" for tau in _RANGES]
    return ["dispersion", *ranges, *(f"error {age:g} s ahead" for age in _AGES)]


def _instant_cells(instant: InstantConsistency) -> list[str]:
    """Return the cells of an observation, escaped."""
    convergence = {entry.range: entry.duration for entry in instant.convergence}
    errors = {entry.age: entry.displacement_error for entry in instant.errors}
    dispersion = instant.dispersion.standard_deviation if instant.HasField("dispersion") else None
    return [
        escape(instant.agent_id),
        f"{instant.time:.2f}",
        escape(model_name(instant.model)),
        _state(instant),
        _number(dispersion, 2),
        *_numbers(map(convergence.get, _RANGES), 1),
        *_numbers(map(errors.get, _AGES), 2),
    ]


def _state(instant: InstantConsistency) -> str:
    if not instant.complete:
        return f"{len(instant.errors)} ages"
    return "settled" if instant.settled else "complete"


def _mean(summary: Summary | None) -> str:
    return _number(summary.mean if summary is not None and summary.count else None, 2)


def _numbers(values: Iterable[float | None], digits: int) -> list[str]:
    return [_number(value, digits) for value in values]


def _number(value: float | None, digits: int) -> str:
    return _NOTHING if value is None else f"{value:.{digits}f}"
