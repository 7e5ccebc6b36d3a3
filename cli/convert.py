"""``cab-forecast convert``: published weights to checkpoints of this project."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cli.failures import fail


class Source(StrEnum):
    """The projects whose weights can be converted."""

    TRAJECTRON = "trajectron"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(name="convert")(convert)


def convert(
    source: Annotated[Source, typer.Argument(help="The project that published the weights.")],
    folder: Annotated[
        Path, typer.Argument(exists=True, file_okay=False, help="Folder with the weights and their settings.")
    ],
    out: Annotated[Path, typer.Option(file_okay=False, help="Folder to write the checkpoint to.")],
    checkpoint: Annotated[int, typer.Option(min=0, help="Number of the checkpoint in the folder.")] = 12,
) -> None:
    """Convert published weights to a checkpoint, without running any code that they contain."""
    from model.checkpoint import CheckpointError  # noqa: PLC0415 (torch is slow to import)
    from model.convert import convert_trajectron  # noqa: PLC0415

    converters = {Source.TRAJECTRON: convert_trajectron}
    try:
        converters[source](folder, checkpoint, out)
    except (OSError, ValueError, CheckpointError) as error:  # an unsafe pickle is a ValueError
        fail(str(error))
    typer.echo(f"wrote {out}")
