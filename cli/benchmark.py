"""``cab-forecast benchmark``: the paper's tables through a running server, and comparisons of two runs."""

import os
import sqlite3
from pathlib import Path
from typing import Annotated

import typer

from cab_forecast.endpoints import DEFAULT_ENDPOINT
from cli.failures import fail
from cli.options import Endpoint, Token

_SAMPLES = 2000


def register(app: typer.Typer) -> None:
    """Adds the command."""
    group = typer.Typer(help=benchmark.__doc__, invoke_without_command=True)
    group.callback()(benchmark)
    group.command("compare")(compare)
    app.add_typer(group, name="benchmark")


def benchmark(
    context: typer.Context,
    data: Annotated[str | None, typer.Option(help="KIND:PATH of the data, e.g. nuscenes_pred:DIR")] = None,
    out: Annotated[
        Path | None,
        typer.Option(file_okay=False, help="Folder for answers and report; an interrupted run goes on."),
    ] = None,
    *,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    token: Token = None,
    split: Annotated[str, typer.Option(help="Split to ask about.")] = "train_val",
    protocol: Annotated[
        str, typer.Option(help="Of the inputs: causal, or paper to compare with published tables.")
    ] = "causal",
    models: Annotated[
        str | None, typer.Option(help="NAME[@VERSION],… [default: all that the endpoint lists]")
    ] = None,
    saved: Annotated[
        Path | None,
        typer.Option(
            "--from", exists=True, file_okay=False, help="Judge the answers saved here; ask nothing."
        ),
    ] = None,
    samples: Annotated[
        int, typer.Option(min=0, help="Trajectories drawn a pair; 0: none, and no calibration.")
    ] = _SAMPLES,
    consistency: Annotated[
        bool, typer.Option("--consistency/--no-consistency", help="Dispersion and convergence, too.")
    ] = True,
    limit: Annotated[int | None, typer.Option(min=1, help="Only so many of the first pairs.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2000, help="Of all that is drawn.")] = 0,
    concurrency: Annotated[int, typer.Option(min=1, help="Calls on their way at once.")] = 16,
    timeout: Annotated[
        float,
        typer.Option(
            min=1, help="Seconds for a call with its retries: how long a lost server is waited for."
        ),
    ] = 60.0,
    processes: Annotated[
        int | None, typer.Option(min=1, help="That judge. [default: the processor's cores]")
    ] = None,
) -> None:
    """Replays a split of recorded data through a running server, and judges what it says."""
    if context.invoked_subcommand is not None:
        return
    folder = out or saved
    if data is None or folder is None:
        fail("--data and --out are needed (--data and --from, to judge saved answers)")
    from benchmark import BenchmarkError  # noqa: PLC0415 (torch is slow to import)
    from benchmark.run import Benchmark  # noqa: PLC0415
    from benchmark.score import Judging  # noqa: PLC0415
    from cli.benchmarking import Asking, show_benchmark  # noqa: PLC0415
    from model.data.scenes import DataError  # noqa: PLC0415
    from model.data.sources import READERS, parse_data, parse_protocol  # noqa: PLC0415
    from model.metrics.density import DRAWS  # noqa: PLC0415

    names = [name.strip() for name in (models or "").split(",") if name.strip()]
    if models is not None and not names:
        fail("models: it names nothing")
    try:
        kind, path = parse_data(data)
        judging = Judging(samples, DRAWS if samples else 0, seed, consistency)
        whole = Benchmark(
            kind, READERS[kind](path), split, parse_protocol(protocol), saved or folder, judging, limit
        )
        asking = None if saved else Asking(endpoint, token, concurrency, timeout)
        missing = show_benchmark(whole, names, asking, folder, processes or len(os.sched_getaffinity(0)))
    except (BenchmarkError, DataError, OSError, ValueError, sqlite3.Error) as error:
        fail(str(error))
    if missing:
        fail(f"{missing} forecasts are missing: the figures are of the others")


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="Folder of a benchmark's results.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Folder of another one's.")],
) -> None:
    """Sets the figures of two runs side by side."""
    from benchmark import BenchmarkError  # noqa: PLC0415
    from benchmark.compare import compare as compared  # noqa: PLC0415
    from benchmark.compare import markdown  # noqa: PLC0415

    try:
        typer.echo(markdown(compared(first, second)), nl=False)
    except BenchmarkError as error:
        fail(str(error))
