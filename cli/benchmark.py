# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for torch
"""``cab-forecast benchmark``: the paper's tables through a running server, and comparisons of two runs."""

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.connection import Connection, with_connection
from cli.failures import fail

if TYPE_CHECKING:
    from benchmark import BenchmarkRun, Endpoint, Progress

_SAMPLES = 2000
_DONORS = 2
_REFUSALS_SHOWN = 5


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(help=benchmark.__doc__, invoke_without_command=True)
    group.callback()(with_connection(benchmark))
    group.command("compare")(compare)
    group.command("seeds")(seeds)
    app.add_typer(group, name="benchmark")


def benchmark(
    context: typer.Context,
    data: Annotated[str | None, typer.Option(help="KIND:PATH of the data, e.g. nuscenes_pred:DIR")] = None,
    out: Annotated[
        Path | None,
        typer.Option(file_okay=False, help="Folder for responses and report; an interrupted run resumes."),
    ] = None,
    *,
    connection: Connection,
    split: Annotated[str, typer.Option(help="Split to evaluate on.")] = "train_val",
    protocol: Annotated[
        str, typer.Option(help="Protocol of the inputs: causal, or paper to compare with published tables.")
    ] = "causal",
    models: Annotated[
        str | None, typer.Option(help="NAME[@VERSION],… [default: all that the endpoint lists]")
    ] = None,
    saved: Annotated[
        Path | None,
        typer.Option(
            "--from",
            exists=True,
            file_okay=False,
            help="Evaluate the responses saved here; send no requests.",
        ),
    ] = None,
    samples: Annotated[
        int, typer.Option(min=0, help="Sampled trajectories per pair; 0: none, and no calibration.")
    ] = _SAMPLES,
    consistency: Annotated[
        bool,
        typer.Option("--consistency/--no-consistency", help="Also compute dispersion and convergence."),
    ] = True,
    measure_context: Annotated[
        bool, typer.Option("--context", help="Also measure what the context does for the forecasts.")
    ] = False,
    donors: Annotated[
        int, typer.Option(min=1, help="With --context: wrong maps, and wrong neighbours, for each pair.")
    ] = _DONORS,
    no_context_model: Annotated[
        str, typer.Option(help="With --context: the model without context, to compare with.")
    ] = "trajectron-no-context",
    no_context_answers: Annotated[
        Path | None,
        typer.Option(
            exists=True, file_okay=False, help="With --context: folder of a run with that model's responses."
        ),
    ] = None,
    explain: Annotated[
        int | None,
        typer.Option(min=1, metavar="PAIRS", help="Also explain so many pairs by Shapley values."),
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Evaluate the first LIMIT pairs only.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2000, help="Seed of all random draws.")] = 0,
    concurrency: Annotated[int, typer.Option(min=1, help="Concurrent requests.")] = 16,
    timeout: Annotated[
        float,
        typer.Option(
            min=1, help="Seconds per call, retries included: how long to wait for a server that is gone."
        ),
    ] = 60.0,
    processes: Annotated[
        int | None, typer.Option(min=1, help="Evaluation processes. [default: the number of CPU cores]")
    ] = None,
) -> None:
    """Replay a split of recorded data through a running server and evaluate its forecasts."""
    if context.invoked_subcommand is not None:
        return
    folder = out or saved
    if data is None or folder is None:
        fail("--data and --out are needed (--data and --from, to evaluate saved responses)")
    from benchmark import Benchmark, BenchmarkError, run_benchmark
    from benchmark.context import ContextSettings
    from benchmark.explanations import ExplanationSettings
    from model.data.scenes import DataError
    from model.data.sources import READERS, parse_data, parse_protocol
    from model.metrics.density import DRAWS
    from model.metrics.pairs import Sampling

    names = [name.strip() for name in (models or "").split(",") if name.strip()]
    if models is not None and not names:
        fail("models: it names nothing")
    try:
        kind, path = parse_data(data)
        run = run_benchmark(
            Benchmark(
                kind,
                READERS[kind](path),
                split,
                parse_protocol(protocol),
                saved or folder,
                Sampling(samples, DRAWS if samples else 0, seed),
                consistency,
                limit,
                ContextSettings(donors, no_context_model, no_context_answers) if measure_context else None,
                None if explain is None else ExplanationSettings(explain),
            ),
            None if saved else _endpoint(connection, concurrency, timeout),
            folder,
            names=names,
            processes=processes or len(os.sched_getaffinity(0)),
            progress=_terminal_progress(),
        )
    except (BenchmarkError, DataError, OSError, ValueError, sqlite3.Error) as error:
        fail(str(error))
    _show(run, folder)
    if missing := run.results.missing:
        fail(f"{missing} forecasts are missing: the metrics leave them out")


def _endpoint(connection: Connection, concurrency: int, timeout: float) -> "Endpoint":
    from benchmark import Endpoint

    return Endpoint(
        connection.endpoint,
        connection.token,
        concurrency,
        timeout,
        connection.ca_file,
        connection.certificate_file,
        connection.key_file,
    )


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="Results folder of a benchmark.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Results folder of another benchmark.")],
) -> None:
    """Show the metrics of two runs side by side.

    Differences have 95 % intervals by bootstrap over scenes (2000 resamples, seed 0).
    """
    from benchmark import BenchmarkError
    from benchmark.compare import compare as compared
    from benchmark.compare import markdown

    try:
        typer.echo(markdown(compared(first, second)), nl=False)
    except BenchmarkError as error:
        fail(str(error))


def seeds(
    a: Annotated[str, typer.Argument(metavar="A", help="Name of a model, e.g. trajectron.")],
    b: Annotated[str, typer.Argument(metavar="B", help="Name of another model, e.g. cab.")],
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN…", help="Results folders, one for each training of A or B.")
    ],
) -> None:
    """Compare two models, each trained with several seeds.

    Differences have 95 % intervals by bootstrap over trainings and scenes (2000 resamples, seed 0).
    """
    from benchmark import BenchmarkError
    from benchmark.seeds import compare_seeds, table
    from model.evaluation.tables import document

    try:
        found = compare_seeds(runs, a, b)
    except BenchmarkError as error:
        fail(str(error))
    typer.echo(document("Comparison of two models over seeds", [table(found, a, b)]), nl=False)


def _terminal_progress() -> "Progress":
    """Return a receiver of progress that shows it on the terminal."""
    from rich.console import Console
    from rich.markup import escape

    from benchmark import Progress
    from cli.display import throughput_bar

    console = Console(stderr=True)

    class TerminalProgress(Progress):
        """Progress on the terminal."""

        def note(self, text: str) -> None:
            console.print(escape(text), highlight=False)

        @contextmanager
        def task(
            self, name: str, total: int | None = None, unit: str = ""
        ) -> Iterator[Callable[[int], None]]:
            if total is None:
                with console.status(name):
                    yield lambda steps: None
                return
            with throughput_bar(console, f"{unit}/s") as bar:
                task = bar.add_task(name, total=total)
                yield lambda steps: bar.advance(task, steps)

    return TerminalProgress()


def _show(run: "BenchmarkRun", out: Path) -> None:
    """Show the tables of a run, its files and the first refused calls."""
    from rich.console import Console
    from rich.markup import escape

    from benchmark.tables import left_out, tables
    from cli.display import show_tables

    show_tables(tables(run.results), out)
    for why in left_out(run.results):
        Console().print(f"[dim]{escape(why)}[/]", highlight=False)
    for file in run.files:
        Console().print(f"  {escape(str(file))}", highlight=False)
    for refusal in run.results.refusals[:_REFUSALS_SHOWN]:
        Console(stderr=True).print(f"[red]refused: {escape(refusal)}[/]", highlight=False)
