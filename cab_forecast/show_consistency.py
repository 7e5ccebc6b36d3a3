"""Consistency as tables in the terminal."""

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cab.forecast.v1.consistency_service_pb2 import (
    GetSceneConsistencyResponse,
    InstantConsistency,
    ModelConsistency,
    Summary,
    WatchSceneResponse,
)
from cab_forecast.names import model_name
from cab_forecast.terminal import unfolded

_AGES = (1.0, 3.0, 6.0)
"""s; of the errors shown."""
_RANGES = (0.2, 1.0, 5.0)
"""m"""
_NOTHING = "–"


def print_instants(
    instants: Sequence[InstantConsistency], title: str = "Observations", console: Console | None = None
) -> None:
    """Prints observations of agents, and how right the forecasts for them were.

    Args:
        instants: in the order to print.
        title: of the table; units are added.
        console: where to print; None: standard output.
    """
    console = unfolded(console)
    if not instants:
        console.print("[dim]nothing that was forecast was observed yet[/]")
        return
    table = _table(
        f"{title}: time in s, distances in m, C(range) in s", "agent", "time", "model", "forecasts"
    )
    for heading in _figures_headings():
        table.add_column(heading, justify="right", no_wrap=True)
    for instant in instants:
        table.add_row(*_instant(instant))
    console.print(table)


def print_models(models: Sequence[ModelConsistency], console: Console | None = None) -> None:
    """Prints what was settled of each model: means over the sets.

    Args:
        models: in the order to print.
        console: where to print; None: standard output.
    """
    console = unfolded(console)
    if not models:
        console.print("[dim]no forecasts were settled yet[/]")
        return
    table = _table("Settled forecasts: means; distances in m, C(range) in s", "model")
    for heading in ("sets", *_figures_headings()):
        table.add_column(heading, justify="right", no_wrap=True)
    for model in models:
        convergence = {entry.range: entry.duration for entry in model.convergence}
        errors = {entry.age: entry.displacement_error for entry in model.errors}
        means = [model.dispersion_standard_deviation, *map(convergence.get, _RANGES), *map(errors.get, _AGES)]
        table.add_row(escape(model_name(model.model)), str(model.instants), *map(_mean, means))
    console.print(table)


def print_scene(response: GetSceneConsistencyResponse, console: Console | None = None) -> None:
    """Prints a scene: its agents, then the sums by model.

    Args:
        response: what the server said.
        console: where to print; None: standard output.
    """
    console = unfolded(console)
    print_instants(response.latest, "Newest observation of each agent", console)
    console.print()
    print_models(response.models, console)


def print_event(event: WatchSceneResponse, console: Console | None = None) -> None:
    """Prints what was found out about a scene, a line for each observation.

    Args:
        event: what the server said.
        console: where to print; None: standard output.
    """
    console = unfolded(console)
    if event.missed:
        console.print(f"[yellow]{event.missed} events were missed[/]", highlight=False)
    for instant in event.instants:
        agent, time, model, forecasts, *figures = _instant(instant)
        named = [f"{name} {figure}" for name, figure in zip(_figures_headings(), figures, strict=True)]
        given = [text for text in named if not text.endswith(_NOTHING)]
        line = "  ".join([time, agent, model, forecasts, *given])
        console.print(line, highlight=False, soft_wrap=True)


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _figures_headings() -> list[str]:
    """Of what ``_instant`` and a model's row end with."""
    ranges = [f"C({tau:g} m)" for tau in _RANGES]
    return ["dispersion", *ranges, *(f"error {age:g} s ahead" for age in _AGES)]


def _instant(instant: InstantConsistency) -> list[str]:
    """Cells of an observation, escaped."""
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
