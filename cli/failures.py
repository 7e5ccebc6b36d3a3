"""One-line errors of commands."""

from typing import NoReturn

import typer


def fail(message: str) -> NoReturn:
    """Print the message to standard error on one line and end the command.

    Raises:
        typer.Exit: always, with code 1.
    """
    typer.secho(f"error: {' '.join(message.split())}", fg=typer.colors.RED, err=True)
    raise typer.Exit(1)
