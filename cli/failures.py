"""How a command ends that cannot do its work: one line, and no traceback."""

from typing import NoReturn

import typer


def fail(message: str) -> NoReturn:
    """Prints the message to standard error and ends the command.

    Raises:
        typer.Exit: always, with code 1.
    """
    typer.secho(f"error: {' '.join(message.split())}", fg=typer.colors.RED, err=True)
    raise typer.Exit(1)
