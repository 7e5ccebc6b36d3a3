"""Where tables are printed."""

from rich.console import Console

UNBOUNDED = 10_000
"""Columns; wider than any table."""


def unfolded(console: Console | None) -> Console:
    """A console that folds no lines but a terminal's.

    Args:
        console: where to print; None: standard output.
    """
    console = console or Console()
    if console.is_terminal:
        return console
    return Console(file=console.file, width=UNBOUNDED)  # a file or a pipe has no width
