"""Tables and progress bars on the terminal."""

from collections.abc import Sequence
from pathlib import Path

from rich import table as rich_table
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from model.evaluation.tables import Table

_UNBOUNDED = 10_000
"""Columns of the console, more than any table has: the terminal wraps long lines, rich would cut them."""


def show_tables(tables: Sequence[Table], folder: Path) -> None:
    """Print tables, and the folder that they were written to."""
    console = Console(width=_UNBOUNDED)
    for table in tables:
        shown = rich_table.Table(title=table.title, title_justify="left", title_style="bold", box=None)
        shown.add_column(table.columns[0], no_wrap=True)
        for column in table.columns[1:]:
            shown.add_column(column, justify="right")
        for row in table.rows:
            shown.add_row(*row)
        console.print(shown)
        console.print(f"[dim]{escape(table.note)}[/]\n", highlight=False)
    console.print(f"written to {escape(str(folder))}", highlight=False)


def throughput_bar(console: Console, unit: str) -> Progress:
    """Return a progress bar with the count, the throughput, and the time elapsed and remaining.

    Args:
        console: where it is drawn.
        unit: the throughput's unit, e.g. "pairs/s".
    """
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _ThroughputColumn(unit),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


def count_up(console: Console) -> Progress:
    """Return a transient spinner for work whose total is unknown."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True)


def batches_bar(console: Console) -> Progress:
    """Return a transient progress bar of the batches of an epoch."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("batches"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )


class _ThroughputColumn(ProgressColumn):
    """Steps per second, with a unit."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:.0f} {self._unit}")
