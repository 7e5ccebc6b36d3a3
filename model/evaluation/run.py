"""A whole evaluation: what ``cab-forecast evaluate`` does."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from model.data.scenes import DataError, Reader
from model.evaluation.baselines import judge_baselines
from model.evaluation.learned import Judged, judge_learned, open_validations
from model.evaluation.results import Results, Row
from model.evaluation.subjects import Subjects
from model.evaluation.tables import markdown
from model.forecaster import ModelInfo, Protocol
from model.metrics.aggregate import MetricMeans
from model.metrics.density import DRAWS
from model.metrics.oracle import ORACLE

RESULTS_FILE = "results.json"
TABLES_FILE = "tables.md"


@dataclass(frozen=True)
class Evaluation:
    """What is judged, and on what."""

    subjects: Subjects
    kind: str
    """Of the data set."""
    reader: Reader
    split: str
    protocol: Protocol
    cache: Path
    """Folder of the caches; training runs may share it."""
    samples: int = 200
    """Trajectories drawn for each pair; 0: none, and no calibration."""
    limit: int | None = None
    """How many of the first pairs; None: all."""
    ablate: bool = False
    """Whether to judge checkpoints with less context, too."""

    def __call__(self, tick: Callable[[str, int], None], said: Callable[[str], None]) -> Results:
        """Judges all models.

        Args:
            tick: told what goes on and how many pairs of it are done.
            said: told in words what else goes on.

        Raises:
            DataError: the data is bad, or the split unknown.
        """
        if self.split not in self.reader.splits:
            raise DataError(f"there is no split {self.split!r}; there are {', '.join(self.reader.splits)}")
        draws = DRAWS if self.samples else 0
        judged: dict[str, Judged] = {}
        validations = open_validations(
            self.subjects.learned, self.cache, self.reader, self.kind, self.split, self.protocol, said
        )
        for validation, models in validations:
            names = ", ".join(model.info.name for model in models)
            judged |= judge_learned(
                validation,
                models,
                self.ablate,
                self.samples,
                draws,
                self.limit,
                partial(tick, names),
            )
        if self.subjects.baselines or self.subjects.oracle:
            means = judge_baselines(
                self.reader,
                self.split,
                self.protocol,
                self.subjects.baselines,
                self.subjects.oracle,
                self.samples,
                draws,
                self.limit,
                partial(tick, "baselines"),
            )
            judged |= {name: Judged(metrics) for name, metrics in means.items()}
        counts = {_pairs(one.metrics) for one in judged.values()}
        if len(counts) > 1:
            raise DataError(f"{self.cache}: holds caches of other data: {sorted(counts)} pairs; remove them")
        return Results(
            data=self.kind,
            split=self.split,
            protocol=self.protocol,
            pairs=counts.pop(),
            limit=self.limit,
            samples=self.samples,
            draws=draws,
            ablate=self.ablate,
            rows=self._rows(judged),
        )

    def _rows(self, judged: Mapping[str, Judged]) -> tuple[Row, ...]:
        """In the order of the tables: baselines, oracle, checkpoints."""
        subjects = self.subjects
        rows = [_row(one.info, judged[one.info.full_name], learned=False) for one in subjects.baselines]
        if subjects.oracle:
            rows.append(
                Row(ORACLE, "", learned=False, trained_on="", metrics=judged[ORACLE].metrics.figures())
            )
        rows += [_row(one.info, judged[one.info.full_name], learned=True) for one in subjects.learned]
        return tuple(rows)


def _row(info: ModelInfo, judged: Judged, learned: bool) -> Row:
    ablated = {without.value: means.figures() for without, means in judged.ablated.items()}
    return Row(info.name, info.version, learned, info.trained_on, judged.metrics.figures(), ablated)


def _pairs(means: MetricMeans) -> int:
    name = "fde_ml_6s_m"
    return means.count(name) + means.missing(name)


def write_results(results: Results, folder: Path) -> None:
    """Writes ``results.json`` and ``tables.md``; what is there is replaced.

    Args:
        results: of an evaluation.
        folder: made where it does not exist.

    Raises:
        OSError: it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULTS_FILE).write_text(results.to_json(), encoding="utf-8")
    (folder / TABLES_FILE).write_text(markdown(results), encoding="utf-8")
