"""A benchmark on the terminal: how far it is, its tables, and the files that it leaves."""

import asyncio
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from benchmark import BenchmarkError
from benchmark.answers import read_answers
from benchmark.archive import Archive
from benchmark.files import replace_text
from benchmark.models import choose, key, unfit
from benchmark.replay import RETRIES
from benchmark.results import Results, write_instances
from benchmark.rules import RULES_FILE, rules
from benchmark.run import Benchmark, listed_models
from benchmark.submission import submission_entries, write_submission
from benchmark.tables import left_out, markdown, tables
from cab.forecast.v1.model_service_pb2 import Model
from cab_forecast import AsyncClient
from cli.tables import show_tables
from model.arrays import Floats

TABLES_FILE = "tables.md"
DRAWN = ("cab", "trajectron")
"""Models whose hard cases are drawn; without either, the first one's."""
_REFUSALS_SHOWN = 5


@dataclass(frozen=True)
class Asking:
    """How an endpoint is asked."""

    endpoint: str
    token: str | None
    concurrency: int
    timeout: float


def show_benchmark(
    whole: Benchmark, names: Sequence[str], asking: Asking | None, out: Path, processes: int
) -> int:
    """Asks, judges and writes; shows how it goes.

    Args:
        whole: the benchmark.
        names: of the models; empty: all.
        asking: whom; None: nobody, the answers are there.
        out: folder of the results.
        processes: that judge.

    Returns:
        How many forecasts are missing.

    Raises:
        BenchmarkError: it cannot go on.
        DataError: the data is bad.
        OSError: the results cannot be written.
    """
    console = Console(stderr=True)
    with console.status("reading the data"):
        forecasts = sum(scene.forecasts for scene in whole.scenes)
    console.print(f"{whole.pairs} pairs, {forecasts} forecasts of each model", highlight=False)
    models = whole.saved_models(names) if asking is None else asyncio.run(_ask(whole, names, asking, console))
    with _bar(console, "pairs/s") as bar:
        task = bar.add_task("judging", total=whole.pairs)
        results, judged = whole.judge(models, processes, lambda pairs: bar.advance(task, pairs))
    out.mkdir(parents=True, exist_ok=True)
    results.write(out)
    write_instances(out, judged.each)
    replace_text(out / TABLES_FILE, markdown(results))
    if text := rules(results):
        replace_text(out / RULES_FILE, text)
    page = _page(whole, results, judged.mismatch_m, out, console)
    written = [*([] if page is None else [page]), *_submissions(whole, models, out, console)]
    show_tables(tables(results), out)
    for why in left_out(results):
        Console().print(f"[dim]{escape(why)}[/]", highlight=False)
    for file in written:
        Console().print(f"  {escape(str(file))}", highlight=False)
    for refusal in results.refusals[:_REFUSALS_SHOWN]:
        console.print(f"[red]refused: {escape(refusal)}[/]", highlight=False)
    return results.missing


async def _ask(whole: Benchmark, names: Sequence[str], asking: Asking, console: Console) -> dict[str, Model]:
    async with AsyncClient(asking.endpoint, asking.token, asking.timeout, RETRIES) as client:
        listed = await listed_models(client)
        models = choose(listed, whole.protocol, names)
        for one in listed:
            if not names and (why := unfit(one, whole.protocol)):
                console.print(escape(f"left out: {key(one)}: {why}"), highlight=False)
        replay = whole.replay(models, asking.concurrency, asking.timeout)
        with _bar(console, "forecasts/s") as bar:
            task = bar.add_task(f"asking {len(models)} models", total=replay.forecasts())
            replayed = await whole.ask(client, asking.endpoint, replay, lambda done: bar.advance(task, done))
    rate = replayed.asked / replayed.seconds if replayed.seconds else 0.0
    console.print(
        f"asked for {replayed.asked} forecasts in {replayed.seconds:.1f} s ({rate:.0f}/s)", highlight=False
    )
    return models


def _submissions(whole: Benchmark, models: Iterable[str], out: Path, console: Console) -> Iterator[Path]:
    """Writes a file a model for the challenge's own evaluator, where the data has the challenge's tokens."""
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


def _page(
    whole: Benchmark, results: Results, mismatch_m: Floats | None, out: Path, console: Console
) -> Path | None:
    try:
        from benchmark.report.page import write_page  # noqa: PLC0415 (an extra)
    except ImportError as error:
        console.print(f"no report.html: {error} (pip install 'cab-forecast[plot]')", highlight=False)
        return None
    asked = [model for model in results.models if model.version]
    drawn = [model.key for model in asked if model.name in DRAWN] or [model.key for model in asked[:1]]
    cases = [] if mismatch_m is None else whole.hard_cases(drawn, mismatch_m)
    return write_page(results, cases, out)


class _Rate(ProgressColumn):
    """How many a second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:.0f} {self._unit}")


def _bar(console: Console, unit: str) -> Progress:
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(unit),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )
