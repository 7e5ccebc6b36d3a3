"""An evaluation on the terminal: how far it is, then its tables."""

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from model.evaluation.results import Results
from model.evaluation.run import Evaluation
from model.evaluation.tables import tables

_UNBOUNDED = 10_000
"""Columns; wider than any table. A narrow terminal folds lines, which loses nothing."""


def show_evaluation(evaluation: Evaluation) -> Results:
    """Runs it, and shows how it goes.

    Raises:
        DataError: the data is bad, or the split unknown.
    """
    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    bar = Progress(*columns, console=console, transient=True)
    with bar:
        task = bar.add_task("starting", total=None)

        def tick(what: str, done: int) -> None:
            bar.update(task, description=f"{what}: {done} pairs")

        return evaluation(tick, console.print)


def show_tables(results: Results, folder: Path) -> None:
    """Prints the tables, and where they were written."""
    console = Console(width=_UNBOUNDED)
    for table in tables(results):
        shown = Table(title=table.title, title_justify="left", title_style="bold", box=None)
        shown.add_column(table.columns[0], no_wrap=True)
        for column in table.columns[1:]:
            shown.add_column(column, justify="right")
        for row in table.rows:
            shown.add_row(*row)
        console.print(shown)
        console.print(f"[dim]{escape(table.note)}[/]\n", highlight=False)
    console.print(f"written to {escape(str(folder))}", highlight=False)
