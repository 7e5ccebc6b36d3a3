"""A whole benchmark: replay, evaluation, and all files of its results."""

import asyncio
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Final

from benchmark.answers import read_answers
from benchmark.archive import Archive
from benchmark.context import ContextBenchmark, ContextSettings
from benchmark.errors import BenchmarkError
from benchmark.evaluate import Evaluated, evaluate
from benchmark.explanations import ExplanationBenchmark, ExplanationSettings
from benchmark.hard_cases import HardCase, hard_case, shown_cases
from benchmark.in_process import replay_in_process
from benchmark.models import describe, key, select, unfit
from benchmark.plan import PlannedScene, digest, plan_scenes
from benchmark.prometheus_rules import RULES_FILE, rules
from benchmark.replay import RETRIES, Replay, Replayed
from benchmark.results import BenchmarkResults
from benchmark.submission import submission_entries, write_submission
from benchmark.tables import markdown
from cab.forecast.v1.model_service_pb2 import Model
from cab_forecast import AsyncClient, ForecastError
from model.arrays import Floats
from model.data.scenes import Reader
from model.evaluation.results import TABLES_FILE, replace_text
from model.forecaster import Forecaster, Protocol
from model.metrics.pairs import Sampling

IN_PROCESS: Final = "in process"
"""Name of the endpoint in results without one."""
_CHANGED: Final = "requesting forecasts with a changed context"
_DRAWN: Final = ("cab", "trajectron")
"""Models whose forecasts of hard cases are drawn; without either, those of the first model."""


@dataclass(frozen=True)
class Endpoint:
    """A running server."""

    address: str
    token: str | None = None
    concurrency: int = 16
    """Maximum number of concurrent calls."""
    timeout: float = 60.0
    """Seconds for a call with its retries; also the time that a lost server is waited for."""
    ca_file: Path | None = None
    """See ``cab_forecast.Client``, as for the two below."""
    certificate_file: Path | None = None
    key_file: Path | None = None


class Progress:
    """Receiver of progress, which ignores it; a subclass may show it."""

    def note(self, text: str) -> None:
        """Receive a message."""

    @contextmanager
    def task(self, name: str, total: int | None = None, unit: str = "") -> Iterator[Callable[[int], None]]:
        """Receive the steps of a task, by a function that is called with their number.

        Args:
            name: the task in words.
            total: number of steps; None: unknown.
            unit: plural of a step.
        """
        yield lambda steps: None


@dataclass(frozen=True)
class BenchmarkRun:
    """Outcome of a benchmark."""

    results: BenchmarkResults
    files: tuple[Path, ...]
    """Report and submissions; beside them are the files that every run has."""


@dataclass(frozen=True)
class Benchmark:
    """Data of a benchmark, and how it is evaluated."""

    kind: str
    """Kind of the data set."""
    reader: Reader
    split: str
    protocol: Protocol
    """Protocol of the inputs."""
    folder: Path
    """Folder of the saved answers."""
    sampling: Sampling
    """Number of random draws."""
    consistency: bool = True
    """Switch for requesting forecasts for dispersion and convergence, too."""
    limit: int | None = None
    """Number of pairs, from the first; None: all."""
    context: ContextSettings | None = None
    """Settings of the measurement of the use of the context; None: it is not measured."""
    explain: ExplanationSettings | None = None
    """Settings of explanations, which an endpoint makes; None: there are none."""

    @cached_property
    def explanations(self) -> ExplanationBenchmark | None:
        """Explanations of some pairs; None: not asked for."""
        if self.explain is None:
            return None
        return ExplanationBenchmark(
            self.folder, self.scenes, self.protocol, self.sampling.seed, self._properties(), self.explain
        )

    @cached_property
    def context_benchmark(self) -> ContextBenchmark | None:
        """Measures of the use of the context; None: not asked for."""
        if self.context is None:
            return None
        return ContextBenchmark(
            self.folder, self.scenes, self.protocol, self.sampling.seed, self._properties(), self.context
        )

    @cached_property
    def scenes(self) -> list[PlannedScene]:
        """Planned scenes.

        Raises:
            DataError: the data is invalid, the split unknown, or without pairs.
        """
        return list(plan_scenes(self.reader, self.split, consistency=self.consistency, limit=self.limit))

    @cached_property
    def plan(self) -> str:
        """Digest of the planned scenes."""
        return digest(self.scenes)

    @property
    def pairs(self) -> int:
        """Number of pairs."""
        return sum(len(scene.pairs) for scene in self.scenes)

    @property
    def forecasts(self) -> int:
        """Number of forecasts requested of each model."""
        return sum(scene.forecasts for scene in self.scenes)

    async def replay(
        self,
        client: AsyncClient,
        endpoint: Endpoint,
        models: Mapping[str, Model],
        tick: Callable[[int], None] = lambda forecasts: None,
    ) -> Replayed:
        """Request all forecasts without a saved answer from an endpoint.

        Args:
            client: client of the endpoint.
            endpoint: the endpoint.
            models: models by ``name@version``.
            tick: called with the number of forecasts of every call, saved ones included.

        Raises:
            BenchmarkError: the folder holds answers of another run, or the endpoint does not answer.
        """
        calls = Replay(self.scenes, models, self.protocol, endpoint.concurrency, endpoint.timeout)
        with self._bound_archive(endpoint.address, endpoint.concurrency, models) as archive:
            return await calls.run(client, archive, tick)

    def replay_in_process(
        self,
        forecasters: Mapping[str, Forecaster],
        tick: Callable[[int], None] = lambda forecasts: None,
    ) -> Replayed:
        """Make all forecasts without a saved answer in this process.

        Args:
            forecasters: forecasters by ``name@version``.
            tick: called with the number of forecasts of every call, saved ones included.

        Raises:
            BenchmarkError: the folder holds answers of another run.
        """
        models = {name: describe(one.info) for name, one in forecasters.items()}
        with self._bound_archive(IN_PROCESS, 1, models) as archive:
            return replay_in_process(self.scenes, forecasters, self.protocol, archive, tick)

    def saved_models(self, names: Sequence[str] = ()) -> dict[str, Model]:
        """Return the models with saved answers, by ``name@version``.

        Args:
            names: ``name`` or ``name@version`` of the models to keep; empty: all.

        Raises:
            BenchmarkError: there are no answers, those of another run, or none of a name.
        """
        with Archive(self.folder, read_only=True) as archive:
            archive.check(self._properties())
            saved = archive.models()
        if not saved:
            raise BenchmarkError(f"{self.folder}: there are no saved answers")
        return select(list(saved.values()), self.protocol, names, str(self.folder)) if names else saved

    def evaluate(
        self,
        models: Mapping[str, Model],
        processes: int = 1,
        tick: Callable[[int], None] = lambda pairs: None,
    ) -> tuple[BenchmarkResults, Evaluated]:
        """Evaluate the saved answers.

        Args:
            models: models by ``name@version``.
            processes: number of processes.
            tick: called after each scene with its number of pairs.

        Returns:
            The results; and the evaluation with the figures of each pair.

        Raises:
            BenchmarkError: an answer does not fit its call, or a process died.
        """
        evaluated = evaluate(
            self.folder, self.scenes, models, self.sampling, self.consistency, processes, tick
        )
        with Archive(self.folder, read_only=True) as archive:
            properties, refusals = archive.facts(), archive.refusals()
        results = BenchmarkResults(
            data=self.kind,
            split=self.split,
            protocol=self.protocol,
            pairs=self.pairs,
            limit=None if self.limit is None or self.limit > self.pairs else self.limit,
            consistency=self.consistency,
            samples=self.sampling.samples,
            draws=self.sampling.draws,
            seed=self.sampling.seed,
            plan=self.plan,
            endpoint=properties.get("endpoint", ""),
            concurrency=int(properties.get("concurrency", 0)),
            version=version("cab-forecast"),
            models=evaluated.models,
            refusals=tuple(str(one) for one in refusals if one.model in models),
        )
        return results, evaluated

    def hard_cases(self, models: Sequence[str], mismatch_m: Floats) -> list[HardCase]:
        """Return the hardest pairs with the forecasts of some models.

        Args:
            models: ``name@version`` of the models.
            mismatch_m: [pairs], m, FDE of the Kalman filter.
        """
        cases = []
        with Archive(self.folder, read_only=True) as archive:
            for scene, number in shown_cases(self.scenes, mismatch_m):
                mixtures = {}
                for model in models:
                    answers = read_answers(archive, model, scene)
                    if answers.mixture is not None and number in answers.instances:
                        row = int(answers.instances.searchsorted(number))
                        mixtures[model] = answers.mixture[row : row + 1]
                cases.append(hard_case(scene, number, float(mismatch_m[scene.first + number]), mixtures))
        return cases

    @contextmanager
    def _bound_archive(
        self, endpoint: str, concurrency: int, models: Mapping[str, Model]
    ) -> Iterator[Archive]:
        with Archive(self.folder) as archive:
            archive.bind(self._properties())
            archive.note("endpoint", endpoint)
            archive.note("concurrency", str(concurrency))
            for name, model in models.items():
                archive.register(name, model)
            yield archive

    def _properties(self) -> dict[str, str]:
        """Return the properties that answers of this run have in common."""
        return {
            "data": self.kind,
            "split": self.split,
            "protocol": self.protocol.value,
            "limit": str(self.limit or "none"),
            "consistency": "yes" if self.consistency else "no",
            "plan": self.plan[:16],
        }


def run_benchmark(
    benchmark: Benchmark,
    source: Endpoint | Sequence[Forecaster] | None,
    out: Path,
    *,
    names: Sequence[str] = (),
    processes: int = 1,
    progress: Progress | None = None,
) -> BenchmarkRun:
    """Replay the data, evaluate the answers and write the results.

    ``out`` then holds ``results.json``, ``tables.md``, ``instances.npz``, ``report.html`` (with the extra
    "plot"), ``benchmark.yml`` (by the causal protocol, without a limit), and a submission for each model if
    the data has the challenge's tokens.

    Args:
        benchmark: the data, and how it is evaluated.
        source: source of the answers: an endpoint, forecasters of this process, or None: the saved answers.
            An endpoint starts an event loop, so that none may be running in this thread.
        out: output folder, created if missing.
        names: ``name`` or ``name@version`` of the models; empty: all that fit the protocol.
        processes: number of processes that evaluate.
        progress: receiver of progress; None: none.

    Raises:
        BenchmarkError: the benchmark cannot go on; the text says why.
        DataError: the data is invalid.
        OSError: a file cannot be written.
    """
    progress = progress or Progress()
    with progress.task("reading the data"):
        forecasts = benchmark.forecasts
    progress.note(f"{benchmark.pairs} pairs, {forecasts} forecasts of each model")
    if source is None:
        models = benchmark.saved_models(names)
    elif isinstance(source, Endpoint):
        models = asyncio.run(_replay(benchmark, source, names, progress))
    else:
        models = _replay_in_process(benchmark, source, names, progress)
    with progress.task("evaluating", benchmark.pairs, "pairs") as tick:
        results, evaluated = benchmark.evaluate(models, processes, tick)
    if benchmark.context_benchmark is not None:
        total = len(benchmark.context_benchmark.cases) * len(models)
        with progress.task("evaluating changed contexts", total, "forecasts") as tick:
            context = benchmark.context_benchmark.evaluate(list(models), evaluated, tick)
        results, evaluated = context.add_to(results, evaluated)
    if benchmark.explanations is not None:
        results = benchmark.explanations.add_to(results)
    out.mkdir(parents=True, exist_ok=True)
    results.write(out)
    evaluated.instances.write(out)
    replace_text(out / TABLES_FILE, markdown(results))
    if text := rules(results):
        replace_text(out / RULES_FILE, text)
    page = _write_page(benchmark, results, evaluated.mismatch_m, out, progress)
    submissions = _write_submissions(benchmark, models, out, progress)
    return BenchmarkRun(results, (*([] if page is None else [page]), *submissions))


async def listed_models(client: AsyncClient) -> list[Model]:
    """Return the models of an endpoint.

    Raises:
        BenchmarkError: the endpoint does not answer.
    """
    try:
        return await client.list_models()
    except ForecastError as error:
        raise BenchmarkError(f"the endpoint does not answer: {error}") from error


async def _replay(
    benchmark: Benchmark, endpoint: Endpoint, names: Sequence[str], progress: Progress
) -> dict[str, Model]:
    async with AsyncClient(
        endpoint.address,
        endpoint.token,
        endpoint.timeout,
        RETRIES,
        ca_file=endpoint.ca_file,
        certificate_file=endpoint.certificate_file,
        key_file=endpoint.key_file,
    ) as client:
        models = _selected(await listed_models(client), benchmark.protocol, names, progress, "the endpoint")
        context = _checked_context(benchmark, models)
        total = benchmark.forecasts * len(models)
        with progress.task(f"requesting {len(models)} models", total, "forecasts") as tick:
            replayed = await benchmark.replay(client, endpoint, models, tick)
        _note_rate(replayed, progress)
        if context is not None:
            with progress.task(
                _CHANGED, len(context.cases) * len(context.asked(models)), "forecasts"
            ) as tick:
                replayed = await context.replay(
                    client, models, endpoint.address, endpoint.concurrency, endpoint.timeout, tick
                )
            _note_rate(replayed, progress, " with a changed context")
        explanations = benchmark.explanations
        if explanations is not None:
            total = len(explanations.pairs) * len(models)
            with progress.task("requesting explanations", total, "explanations") as tick:
                await explanations.replay(client, models, endpoint.timeout, tick)
    return models


def _replay_in_process(
    benchmark: Benchmark, forecasters: Sequence[Forecaster], names: Sequence[str], progress: Progress
) -> dict[str, Model]:
    by_key = {one.info.full_name: one for one in forecasters}
    listed = [describe(one.info) for one in forecasters]
    models = _selected(listed, benchmark.protocol, names, progress, "this process")
    chosen = {name: by_key[name] for name in models}
    context = _checked_context(benchmark, models)
    total = benchmark.forecasts * len(models)
    with progress.task(f"running {len(models)} models", total, "forecasts") as tick:
        replayed = benchmark.replay_in_process(chosen, tick)
    _note_rate(replayed, progress)
    if context is not None:
        with progress.task(_CHANGED, len(context.cases) * len(context.asked(models)), "forecasts") as tick:
            replayed = context.replay_in_process(IN_PROCESS, chosen, tick)
        _note_rate(replayed, progress, " with a changed context")
    return models


def _checked_context(benchmark: Benchmark, models: Mapping[str, Model]) -> ContextBenchmark | None:
    """Return the measures of the context, if they are asked for and can be made of these models."""
    context = benchmark.context_benchmark
    if context is not None:
        context.check(list(models))
    return context


def _selected(
    listed: Sequence[Model], protocol: Protocol, names: Sequence[str], progress: Progress, place: str
) -> dict[str, Model]:
    models = select(listed, protocol, names, place)
    for one in listed:
        if not names and (why := unfit(one, protocol)):
            progress.note(f"left out: {key(one)}: {why}")
    return models


def _note_rate(replayed: Replayed, progress: Progress, of: str = "") -> None:
    rate = replayed.requested / replayed.seconds if replayed.seconds else 0.0
    progress.note(
        f"requested {replayed.requested} forecasts{of} in {replayed.seconds:.1f} s ({rate:.0f} forecasts/s)"
    )


def _write_submissions(
    benchmark: Benchmark, models: Iterable[str], out: Path, progress: Progress
) -> Iterator[Path]:
    """Write a submission for each model that answered all pairs, if the data has the challenge's tokens."""
    if not all(pair.token for scene in benchmark.scenes for pair in scene.pairs):
        return
    with Archive(benchmark.folder, read_only=True) as archive:
        for model in models:
            file = out / f"submission-{model}.json"
            entries = (
                submission_entries(scene, read_answers(archive, model, scene)) for scene in benchmark.scenes
            )
            try:
                write_submission(chain.from_iterable(entries), file)
            except BenchmarkError as error:
                progress.note(f"no submission of {model}: {error}")
            else:
                yield file


def _write_page(
    benchmark: Benchmark, results: BenchmarkResults, mismatch_m: Floats | None, out: Path, progress: Progress
) -> Path | None:
    try:
        from benchmark.report.page import write_page  # noqa: PLC0415 (an extra)
    except ImportError as error:
        progress.note(f"no report.html: {error} (pip install 'cab-forecast[plot]')")
        return None
    called = [model for model in results.models if model.version]
    drawn = [model.key for model in called if model.name in _DRAWN] or [model.key for model in called[:1]]
    cases = [] if mismatch_m is None else benchmark.hard_cases(drawn, mismatch_m)
    return write_page(results, cases, out)
