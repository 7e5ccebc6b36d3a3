"""From process start to ready, and the memory it then holds: ``python -m loadtest.startup``.

The server has one learned model, a CAB network of seeded random weights unless a folder of checkpoints
is given; it runs the demo request before its memory is read.
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Annotated, NamedTuple

import psutil
import typer
from rich.console import Console

from cab_forecast import Client
from cab_forecast.demo import demo_request

_ADDRESS = re.compile(r"ready .*grpc=(\S+)")


class Start(NamedTuple):
    """One start."""

    seconds: float
    """From the process's start to its being ready."""
    resident: int
    """Bytes, after one forecast."""


def start_once(models: Path) -> Start:
    """Starts a server on free ports, calls it once and ends it."""
    program = str(Path(sys.executable).with_name("cab-forecast"))
    ports = ["--http", "127.0.0.1:0", "--grpc", "127.0.0.1:0"]
    command = [program, "serve", "--models", str(models), *ports]
    begin = time.perf_counter()
    process = subprocess.Popen(  # noqa: S603
        command, stderr=subprocess.STDOUT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None  # noqa: S101 (for the type checker: it is a pipe)
        for line in process.stdout:
            if found := _ADDRESS.search(re.sub(r"\x1b\[[0-9;]*m", "", line)):
                seconds = time.perf_counter() - begin
                break
        else:
            raise typer.Exit(process.wait())
        with Client(f"grpc://{found[1]}") as client:
            client.predict(demo_request())
        return Start(seconds, psutil.Process(process.pid).memory_info().rss)
    finally:
        process.terminate()
        process.communicate()


def random_checkpoint(folder: Path) -> None:
    """A CAB checkpoint of the full size."""
    from model.bench import cab_network  # noqa: PLC0415 (torch is slow to import)
    from model.checkpoint import save_checkpoint  # noqa: PLC0415

    model = cab_network()
    save_checkpoint(
        folder / "cab", model.info, model.config, model.networks.state_dict(), "Random weights, to measure."
    )


def main(
    models: Annotated[Path | None, typer.Option(help="folder of checkpoints; default: a random CAB")] = None,
    repeats: Annotated[int, typer.Option(min=1)] = 5,
) -> None:
    """Prints the medians; the first start, which warms the disk, is left out."""
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
