"""Requests and evaluation of forecasts with a changed context, beside those of a benchmark."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

from benchmark.archive import Archive, Refusal
from benchmark.bootstrap import Ratio
from benchmark.context.cases import Cases, ContextSettings
from benchmark.context.measures import (
    ContextEvaluation,
    context_subsets,
    measure_context,
    measures_by_scenes,
    most_likely_paths,
)
from benchmark.errors import BenchmarkError
from benchmark.evaluate import Evaluated
from benchmark.in_process import replay_in_process
from benchmark.models import BASELINES, describe, select
from benchmark.plan import PlannedScene
from benchmark.replay import Replay, Replayed
from benchmark.results import FDE, BenchmarkResults, ContextRun, Estimate
from cab.forecast.v1.model_service_pb2 import Model
from cab_forecast import AsyncClient
from model.arrays import Floats
from model.forecaster import Forecaster, Protocol

FOLDER: Final = "context"
"""Folder of the answers about the cases, inside that of the run."""
_TIMED: Final = "timed"
_SECONDS: Final = "seconds"


@dataclass(frozen=True)
class ContextEvaluated:
    """Measures of all models."""

    run: ContextRun
    measures: Mapping[str, Mapping[str, Mapping[str, Estimate]]]
    """Values by ``name@version``, subset and name."""
    missing: Mapping[str, int]
    """Number of cases without a forecast, by ``name@version``."""
    each: Mapping[str, Floats]
    """[pairs], m, differences of errors by ``<name@version>/<name>``, NaN where unknown."""
    ratios: Mapping[str, Ratio]
    """Each measure as a ratio of sums over the scenes, by ``<name@version>/<name>``."""
    refusals: Sequence[Refusal]
    """Calls that the endpoint refused."""

    def add_to(self, results: BenchmarkResults, evaluated: Evaluated) -> tuple[BenchmarkResults, Evaluated]:
        """Return results and the figures of each pair with these measures."""
        models = tuple(
            replace(
                model,
                context=self.measures.get(model.key, {}),
                context_missing=self.missing.get(model.key, 0),
            )
            for model in results.models
        )
        refusals = (*results.refusals, *map(str, self.refusals))
        held = evaluated.instances
        instances = replace(
            held, figures={**held.figures, **self.each}, ratios={**held.ratios, **self.ratios}
        )
        return (
            replace(results, models=models, context=self.run, refusals=refusals),
            replace(evaluated, instances=instances),
        )


@dataclass(frozen=True)
class ContextBenchmark:
    """Measures of what the context does for the forecasts of a benchmark."""

    folder: Path
    """Folder of the benchmark's answers."""
    scenes: Sequence[PlannedScene]
    protocol: Protocol
    seed: int
    properties: Mapping[str, str]
    """Properties of the benchmark, which its answers are bound to."""
    settings: ContextSettings

    @cached_property
    def cases(self) -> Cases:
        """All cases."""
        return Cases(self.scenes, self.settings.donors, self.seed)

    @staticmethod
    def asked(models: Iterable[str]) -> list[str]:
        """Return the models that are asked; physics baselines are not, since they see no context.

        Args:
            models: ``name@version`` of the models.
        """
        return [key for key in models if key.partition("@")[0] not in BASELINES]

    def check(self, models: Sequence[str]) -> None:
        """Refuse to begin without a model to compare with.

        Args:
            models: ``name@version`` of the models that will be asked.

        Raises:
            BenchmarkError: the model without context is not among them, and has no saved answers.
        """
        name = self.settings.no_context
        asked = any(name in (key, key.partition("@")[0]) for key in models)
        if self.settings.no_context_answers is not None or not asked:
            try:
                self._no_context()
            except BenchmarkError as error:
                raise BenchmarkError(
                    f"the measures of the context need forecasts of {name!r}: ask it, too, or give a folder "
                    f"with its answers: {error}"
                ) from error

    async def replay(
        self,
        client: AsyncClient,
        models: Mapping[str, Model],
        address: str,
        concurrency: int,
        patience: float,
        tick: Callable[[int], None],
    ) -> Replayed:
        """Request the forecasts of all cases without a saved answer from an endpoint.

        Args:
            client: client of the endpoint.
            models: models by ``name@version``.
            address: address of the endpoint.
            concurrency: maximum number of concurrent calls.
            patience: seconds for a call with its retries.
            tick: called with the number of forecasts of every call, saved ones included.

        Raises:
            BenchmarkError: the folder holds answers of another run, or the endpoint does not answer.
        """
        with self._bound_archive(address, models) as archive:
            if not (asked := self.asked(models)):
                return Replayed()
            cases = self._unanswered(archive, asked, tick)
            replay = Replay(cases, {key: models[key] for key in asked}, self.protocol, concurrency, patience)
            return _timed(archive, await replay.run(client, archive, tick))

    def replay_in_process(
        self, address: str, forecasters: Mapping[str, Forecaster], tick: Callable[[int], None]
    ) -> Replayed:
        """Make the forecasts of all cases without a saved answer in this process.

        Args:
            address: name of this process.
            forecasters: forecasters by ``name@version``.
            tick: called with the number of forecasts of every call, saved ones included.

        Raises:
            BenchmarkError: the folder holds answers of another run.
        """
        models = {name: describe(one.info) for name, one in forecasters.items()}
        with self._bound_archive(address, models) as archive:
            if not (asked := self.asked(models)):
                return Replayed()
            cases = self._unanswered(archive, asked, tick)
            chosen = {name: forecasters[name] for name in asked}
            return _timed(archive, replay_in_process(cases, chosen, self.protocol, archive, tick))

    def evaluate(
        self, models: Sequence[str], evaluated: Evaluated, tick: Callable[[int], None] = lambda cases: None
    ) -> ContextEvaluated:
        """Evaluate the saved answers.

        Args:
            models: ``name@version`` of the models.
            evaluated: evaluation of the benchmark.
            tick: called with the number of cases that are done.

        Raises:
            BenchmarkError: answers are missing, are those of another run, or do not fit their calls.
        """
        folder, reference = self._no_context()
        evaluation = ContextEvaluation(self.cases, self.scenes, self._paths(folder, reference))
        no_context_fde_m = evaluation.no_context_fde_m()
        subsets = context_subsets(self.scenes, evaluated.mismatch_m)
        measures, missing, each, ratios = {}, {}, {}, {}
        asked = self.asked(models)
        with Archive(self.folder / FOLDER, read_only=True) as archive:
            archive.check(self._properties())
            for model in models:
                own = evaluated.instances.figures.get(f"{model}/{FDE}")
                if own is None:
                    continue
                if model in asked:
                    path_of = evaluation.answers(archive, model)
                else:
                    path_of = evaluation.unchanged(self._paths(self.folder, model))
                figures = evaluation.figures(path_of, own, tick)
                measured = (figures, no_context_fde_m, subsets, evaluation.scene_of)
                measures[model] = measure_context(*measured)
                for name, ratio in measures_by_scenes(*measured).items():
                    ratios[f"{model}/{name}"] = ratio
                missing[model] = figures.missing if model in asked else 0
                for name, values in figures.differences(no_context_fde_m).items():
                    each[f"{model}/{name}"] = values
            run = ContextRun(reference, self.settings.donors, len(self.cases), *_durations(archive))
            refusals = [one for one in archive.refusals() if one.model in models]
            return ContextEvaluated(run, measures, missing, each, ratios, refusals)

    def _paths(self, folder: Path, model: str) -> Floats:
        """Return the most likely trajectories of a model's answers in a benchmark's folder: [N, 12, 2], m."""
        with Archive(folder, read_only=True) as archive:
            return most_likely_paths(archive, model, self.scenes)

    def _no_context(self) -> tuple[Path, str]:
        """Return the folder with answers of the model without context, and its ``name@version``."""
        folder = self.settings.no_context_answers or self.folder
        with Archive(folder, read_only=True) as archive:
            archive.check(self.properties)
            saved = list(archive.models().values())
        (model,) = select(saved, self.protocol, [self.settings.no_context], str(folder))
        return folder, model

    def _unanswered(self, archive: Archive, models: Sequence[str], tick: Callable[[int], None]) -> Cases:
        left = self.cases.unanswered(archive.answered(), models)
        tick((len(self.cases) - len(left)) * len(models))
        return left

    @contextmanager
    def _bound_archive(self, address: str, models: Mapping[str, Model]) -> Iterator[Archive]:
        with Archive(self.folder / FOLDER) as archive:
            archive.bind(self._properties())
            archive.note("endpoint", address)
            for name, model in models.items():
                archive.register(name, model)
            yield archive

    def _properties(self) -> dict[str, str]:
        return {**self.properties, "donors": str(self.settings.donors), "seed": str(self.seed)}


def _durations(archive: Archive) -> tuple[int, float]:
    """Return how many forecasts were timed, and the seconds that they took."""
    facts = archive.facts()
    return int(facts.get(_TIMED, "0")), float(facts.get(_SECONDS, "0"))


def _timed(archive: Archive, replayed: Replayed) -> Replayed:
    """Add the duration of a replay to that of earlier ones."""
    timed, seconds = _durations(archive)
    archive.note(_TIMED, str(timed + replayed.requested))
    archive.note(_SECONDS, str(seconds + replayed.seconds))
    return replayed
