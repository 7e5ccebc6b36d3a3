"""Tables of text on the terminal."""

from collections.abc import Sequence
from pathlib import Path

from rich import table as rich_table
from rich.console import Console
from rich.markup import escape

from model.evaluation.text_tables import Table

_UNBOUNDED = 10_000
"""Columns; wider than any table. A narrow terminal folds lines, which loses nothing."""


def show_tables(tables: Sequence[Table], folder: Path) -> None:
    """Prints tables, and where they were written."""
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
