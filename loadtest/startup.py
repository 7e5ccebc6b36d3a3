"""Time from process start to ready, and resident memory: ``python -m loadtest.startup``.

The server has one learned model: a CAB network with seeded random weights, unless a folder of checkpoints is
given. It answers the demo request before its memory is measured.
"""

import tempfile
from pathlib import Path
from statistics import median
from typing import Annotated, NamedTuple

import psutil
import typer
from rich.console import Console

from cab_forecast import Client
from cab_forecast.demo import demo_request
from loadtest.servers import random_checkpoint, serving


class Start(NamedTuple):
    """One start."""

    seconds: float
    """Seconds from the start of the process until it was ready."""
    resident: int
    """Resident memory after one forecast, bytes."""


def start_once(models: Path) -> Start:
    """Start a server on free ports, call it once and stop it."""
    with serving(models) as server:
        with Client(f"grpc://{server.grpc}") as client:
            client.predict(demo_request())
        return Start(server.seconds, psutil.Process(server.process.pid).memory_info().rss)


def main(
    models: Annotated[Path | None, typer.Option(help="folder of checkpoints; default: a random CAB")] = None,
    repeats: Annotated[int, typer.Option(min=1)] = 5,
) -> None:
    """Print the medians, without the first start, which fills the disk cache."""
    with tempfile.TemporaryDirectory() as scratch:
        if models is None:
            random_checkpoint(Path(scratch))
        starts = [start_once(models or Path(scratch)) for _ in range(repeats + 1)][1:]
    seconds, resident = median(s.seconds for s in starts), median(s.resident for s in starts)
    Console().print(
        f"start to ready {seconds:.2f} s, resident {resident / 2**20:.0f} MiB, median of {repeats}"
    )


if __name__ == "__main__":
    typer.run(main)
