# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for torch
"""``cab-forecast benchmark``: the paper's tables through a running server, and comparisons of two runs."""

import asyncio
import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cab_forecast.endpoints import DEFAULT_ENDPOINT
from cli.connection import Endpoint, Token
from cli.failures import fail

if TYPE_CHECKING:
    from rich.console import Console

    from benchmark.results import Results
    from benchmark.run import Benchmark
    from cab.forecast.v1.model_service_pb2 import Model
    from model.arrays import Floats

TABLES_FILE = "tables.md"
PLOTTED = ("cab", "trajectron")
"""Models whose hard cases are plotted; if neither is there, the first model is."""
_SAMPLES = 2000
_REFUSALS_SHOWN = 5


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(help=benchmark.__doc__, invoke_without_command=True)
    group.callback()(benchmark)
    group.command("compare")(compare)
    app.add_typer(group, name="benchmark")


def benchmark(
    context: typer.Context,
    data: Annotated[str | None, typer.Option(help="KIND:PATH of the data, e.g. nuscenes_pred:DIR")] = None,
    out: Annotated[
        Path | None,
        typer.Option(file_okay=False, help="Folder for responses and report; an interrupted run resumes."),
    ] = None,
    *,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    token: Token = None,
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
    from benchmark import BenchmarkError
    from benchmark.run import Benchmark
    from benchmark.score import Judging
    from model.data.scenes import DataError
    from model.data.sources import READERS, parse_data, parse_protocol
    from model.metrics.density import DRAWS

    names = [name.strip() for name in (models or "").split(",") if name.strip()]
    if models is not None and not names:
        fail("models: it names nothing")
    try:
        kind, path = parse_data(data)
        judging = Judging(samples, DRAWS if samples else 0, seed, consistency)
        whole = Benchmark(
            kind, READERS[kind](path), split, parse_protocol(protocol), saved or folder, judging, limit
        )
        target = None if saved else _Target(endpoint, token, concurrency, timeout)
        missing = _run(whole, names, target, folder, processes or len(os.sched_getaffinity(0)))
    except (BenchmarkError, DataError, OSError, ValueError, sqlite3.Error) as error:
        fail(str(error))
    if missing:
        fail(f"{missing} forecasts are missing: the metrics leave them out")


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="Results folder of a benchmark.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Results folder of another benchmark.")],
) -> None:
    """Show the metrics of two runs side by side."""
    from benchmark import BenchmarkError
    from benchmark.compare import compare as compared
    from benchmark.compare import markdown

    try:
        typer.echo(markdown(compared(first, second)), nl=False)
    except BenchmarkError as error:
        fail(str(error))


@dataclass(frozen=True)
class _Target:
    """The endpoint under test and the load on it."""

    endpoint: str
    token: str | None
    concurrency: int
    timeout: float
    """Seconds per call, retries included."""


def _run(whole: "Benchmark", names: Sequence[str], target: _Target | None, out: Path, processes: int) -> int:
    """Run a benchmark and write its results; show progress, tables and files.

    Args:
        whole: the benchmark.
        names: the models; empty: all.
        target: the endpoint; None: evaluate the saved responses.
        out: folder of the results.
        processes: evaluation processes.

    Returns:
        The number of missing forecasts.

    Raises:
        BenchmarkError: the benchmark cannot continue.
        DataError: the data is bad.
        OSError: the results cannot be written.
    """
    from rich.console import Console
    from rich.markup import escape

    from benchmark.files import replace_text
    from benchmark.results import write_instances
    from benchmark.rules import RULES_FILE, rules
    from benchmark.tables import left_out, markdown, tables
    from cli.display import show_tables, throughput_bar

    console = Console(stderr=True)
    with console.status("reading the data"):
        forecasts = sum(scene.forecasts for scene in whole.scenes)
    console.print(f"{whole.pairs} pairs, {forecasts} forecasts of each model", highlight=False)
    if target is None:
        models = whole.saved_models(names)
    else:
        models = asyncio.run(_replay(whole, names, target, console))
    with throughput_bar(console, "pairs/s") as bar:
        task = bar.add_task("evaluating", total=whole.pairs)
        results, judged = whole.judge(models, processes, lambda pairs: bar.advance(task, pairs))
    out.mkdir(parents=True, exist_ok=True)
    results.write(out)
    write_instances(out, judged.each)
    replace_text(out / TABLES_FILE, markdown(results))
    if text := rules(results):
        replace_text(out / RULES_FILE, text)
    page = _write_page(whole, results, judged.mismatch_m, out, console)
    written = [*([] if page is None else [page]), *_write_submissions(whole, models, out, console)]
    show_tables(tables(results), out)
    for why in left_out(results):
        Console().print(f"[dim]{escape(why)}[/]", highlight=False)
    for file in written:
        Console().print(f"  {escape(str(file))}", highlight=False)
    for refusal in results.refusals[:_REFUSALS_SHOWN]:
        console.print(f"[red]refused: {escape(refusal)}[/]", highlight=False)
    return results.missing


async def _replay(
    whole: "Benchmark", names: Sequence[str], target: _Target, console: "Console"
) -> dict[str, "Model"]:
    """Request the forecasts that are not saved yet; return the models by ``name@version``."""
    from rich.markup import escape

    from benchmark.models import choose, key, unfit
    from benchmark.replay import RETRIES
    from benchmark.run import listed_models
    from cab_forecast import AsyncClient
    from cli.display import throughput_bar

    async with AsyncClient(target.endpoint, target.token, target.timeout, RETRIES) as client:
        listed = await listed_models(client)
        models = choose(listed, whole.protocol, names)
        for one in listed:
            if not names and (why := unfit(one, whole.protocol)):
                console.print(escape(f"left out: {key(one)}: {why}"), highlight=False)
        replay = whole.replay(models, target.concurrency, target.timeout)
        with throughput_bar(console, "forecasts/s") as bar:
            task = bar.add_task(f"requesting {len(models)} models", total=replay.forecasts())
            replayed = await whole.ask(client, target.endpoint, replay, lambda done: bar.advance(task, done))
    rate = replayed.asked / replayed.seconds if replayed.seconds else 0.0
    console.print(
        f"requested {replayed.asked} forecasts in {replayed.seconds:.1f} s ({rate:.0f}/s)", highlight=False
    )
    return models


def _write_submissions(
    whole: "Benchmark", models: Iterable[str], out: Path, console: "Console"
) -> Iterator[Path]:
    """Write a file per model for the challenge's own evaluator, if the data has the challenge's tokens."""
    from rich.markup import escape

    from benchmark import BenchmarkError
    from benchmark.answers import read_answers
    from benchmark.archive import Archive
    from benchmark.submission import submission_entries, write_submission

    if not all(pair.token for scene in whole.scenes for pair in scene.pairs):
        return
    with Archive(whole.folder, read_only=True) as archive:
        for model in models:
            file = out / f"submission-{model}.json"
            each = (submission_entries(scene, read_answers(archive, model, scene)) for scene in whole.scenes)
            try:
                write_submission(chain.from_iterable(each), file)
            except BenchmarkError as error:
                console.print(escape(f"no submission of {model}: {error}"), highlight=False)
            else:
                yield file


def _write_page(
    whole: "Benchmark", results: "Results", mismatch_m: "Floats | None", out: Path, console: "Console"
) -> Path | None:
    """Write the report with plots of hard cases; None if matplotlib or jinja2 is not installed."""
    try:
        from benchmark.report.page import write_page  # an extra
    except ImportError as error:
        console.print(f"no report.html: {error} (pip install 'cab-forecast[plot]')", highlight=False)
        return None
    served = [model for model in results.models if model.version]
    plotted = [model.key for model in served if model.name in PLOTTED] or [model.key for model in served[:1]]
    cases = [] if mismatch_m is None else whole.hard_cases(plotted, mismatch_m)
    return write_page(results, cases, out)
