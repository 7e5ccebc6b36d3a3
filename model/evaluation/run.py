"""A whole evaluation in this process: the work of ``cab-forecast evaluate``."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from model.data.scenes import DataError, Reader
from model.evaluation.in_process import ModelMeans, evaluate_baselines, evaluate_checkpoints, open_validations
from model.evaluation.results import TABLES_FILE, EvaluationModelResult, EvaluationResults, replace_text
from model.evaluation.selection import Selection
from model.evaluation.tables import markdown
from model.forecaster import ModelInfo, Protocol
from model.metrics.aggregate import MetricMeans
from model.metrics.density import DRAWS
from model.metrics.oracle import ORACLE
from model.metrics.pairs import Sampling


@dataclass(frozen=True)
class Evaluation:
    """Models and data of an evaluation."""

    models: Selection
    kind: str
    """Kind of the data set."""
    reader: Reader
    split: str
    protocol: Protocol
    """Protocol of the inputs."""
    cache: Path
    """Folder of the caches; training runs may share it."""
    samples: int = 200
    """Trajectories drawn for each pair; 0: none, and no calibration."""
    limit: int | None = None
    """Number of pairs, from the first; None: all."""
    ablate: bool = False
    """Switch for evaluating checkpoints with less context, too."""

    def __call__(self, tick: Callable[[str, int], None], log: Callable[[str], None]) -> EvaluationResults:
        """Evaluate all models.

        Args:
            tick: called with the names of the current models and the number of pairs done.
            log: called with other messages.

        Raises:
            DataError: the data is invalid, or the split unknown.
        """
        if self.split not in self.reader.splits:
            raise DataError(f"there is no split {self.split!r}; there are {', '.join(self.reader.splits)}")
        sampling = Sampling(self.samples, DRAWS if self.samples else 0)
        means: dict[str, ModelMeans] = {}
        validations = open_validations(
            self.models.learned, self.cache, self.reader, self.kind, self.split, self.protocol, log
        )
        for validation, models in validations:
            names = ", ".join(model.info.name for model in models)
            means |= evaluate_checkpoints(
                validation, models, self.ablate, sampling, self.limit, partial(tick, names)
            )
        if self.models.baselines or self.models.oracle:
            baselines = evaluate_baselines(
                self.reader,
                self.split,
                self.protocol,
                self.models.baselines,
                self.models.oracle,
                sampling,
                self.limit,
                partial(tick, "baselines"),
            )
            means |= {name: ModelMeans(metrics) for name, metrics in baselines.items()}
        counts = {_pairs(one.metrics) for one in means.values()}
        if len(counts) > 1:
            raise DataError(f"{self.cache}: holds caches of other data: {sorted(counts)} pairs; remove them")
        return EvaluationResults(
            data=self.kind,
            split=self.split,
            protocol=self.protocol,
            pairs=counts.pop(),
            limit=self.limit,
            samples=sampling.samples,
            draws=sampling.draws,
            ablate=self.ablate,
            models=self._results(means),
        )

    def _results(self, means: Mapping[str, ModelMeans]) -> tuple[EvaluationModelResult, ...]:
        """Return results in the order of the tables: baselines, oracle, checkpoints."""
        models = self.models
        rows = [_result(one.info, means[one.info.full_name], learned=False) for one in models.baselines]
        if models.oracle:
            metrics = means[ORACLE].metrics.figures()
            rows.append(
                EvaluationModelResult(name=ORACLE, version="", learned=False, trained_on="", metrics=metrics)
            )
        rows += [_result(one.info, means[one.info.full_name], learned=True) for one in models.learned]
        return tuple(rows)


def write_results(results: EvaluationResults, folder: Path) -> None:
    """Write ``results.json`` and ``tables.md``, replacing existing files.

    Args:
        results: results of an evaluation.
        folder: output folder, created if missing.

    Raises:
        OSError: a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    results.write(folder)
    replace_text(folder / TABLES_FILE, markdown(results))


def _result(info: ModelInfo, means: ModelMeans, learned: bool) -> EvaluationModelResult:
    return EvaluationModelResult(
        name=info.name,
        version=info.version,
        learned=learned,
        trained_on=info.trained_on,
        metrics=means.metrics.figures(),
        ablated={without.value: ablated.figures() for without, ablated in means.ablated.items()},
    )


def _pairs(means: MetricMeans) -> int:
    name = "fde_ml_6s_m"
    return means.count(name) + means.missing(name)
