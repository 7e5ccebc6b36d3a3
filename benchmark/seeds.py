"""Comparison of two methods over trainings with several seeds.

Each training is judged by a run of its own on the same pairs. The 95 % intervals are by bootstrap over
trainings and scenes at once (``benchmark.bootstrap``). So they hold what a single training does not show:
that another seed would have come to another figure.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark.bootstrap import LEVEL, RESAMPLES, SEED, difference_interval
from benchmark.compare import KEY_FIGURES, bounds
from benchmark.errors import BenchmarkError
from benchmark.results import BenchmarkModelResult, BenchmarkResults, Instances
from model.evaluation.tables import UNKNOWN, Table, number, signed

_SETTINGS = ("pairs", "plan", "protocol", "samples", "draws")
"""Settings that the runs must share."""


@dataclass(frozen=True)
class SeedFigure:
    """One figure of two methods over their trainings."""

    figure: str
    metric: str
    """Name of the figure among a model's."""
    a: tuple[float, ...]
    """Figure of each training of A."""
    b: tuple[float, ...]
    interval: tuple[float, float]
    """95 % interval of the difference of the means, B − A; NaN where a run does not hold the figure by
    scenes, or where the trainings' figures are of different pairs."""

    @property
    def difference(self) -> float:
        """Difference of the means, B − A."""
        return float(np.mean(self.b) - np.mean(self.a))


def compare_seeds(runs: Sequence[Path], a: str, b: str) -> list[SeedFigure]:
    """Compare two methods over the runs of their trainings.

    Args:
        runs: folders of runs on the same pairs. A run without one of the methods counts for the other alone.
        a: name of the one model; each run has at most one version of it.
        b: name of the other.

    Returns:
        The figures that all trainings have.

    Raises:
        BenchmarkError: a folder has no results, the runs are of other pairs, or a method is in none.
    """
    if len({run.resolve() for run in runs}) < len(runs):
        raise BenchmarkError("a run is given twice")
    results = [BenchmarkResults.read(run) for run in runs]
    for run, one in zip(runs, results, strict=True):
        for name in _SETTINGS:
            if getattr(one, name) != getattr(results[0], name):
                raise BenchmarkError(f"{run}: is of other {name} than {runs[0]}")
    measured = [(run, one.context_settings) for run, one in zip(runs, results, strict=True) if one.context]
    for run, settings in measured:
        if settings != measured[0][1]:
            raise BenchmarkError(
                f"{run}: measured the context against another model, or with other donors, than "
                f"{measured[0][0]}"
            )
    instances = [Instances.read(run, one.pairs) for run, one in zip(runs, results, strict=True)]
    trainings = [_trainings(name, results, instances) for name in (a, b)]
    for name, found in zip((a, b), trainings, strict=True):
        if not found:
            raise BenchmarkError(f"no run has {name}")
    figures = []
    for figure, metric in KEY_FIGURES.items():
        values = [tuple(model.figure(metric) for model, _ in one) for one in trainings]
        if not np.isfinite(np.concatenate(values)).all():
            continue
        interval = (math.nan, math.nan)
        each = [[own.ratio(model.key, metric) for model, own in one] for one in trainings]
        known = [[ratio for ratio in one if ratio is not None] for one in each]
        if list(map(len, known)) == list(map(len, each)):
            interval = difference_interval(*known)
        figures.append(SeedFigure(figure, metric, values[0], values[1], interval))
    return figures


def table(figures: Sequence[SeedFigure], a: str, b: str) -> Table:
    """Return the comparison as a table."""
    seeds = [len(figures[0].a), len(figures[0].b)] if figures else [0, 0]
    note = (
        f"Means ± standard deviations over {seeds[0]} and {seeds[1]} trainings; {b} − {a} with its "
        f"{100 * LEVEL:g} % interval by bootstrap over trainings and scenes ({RESAMPLES} resamples, seed "
        f"{SEED}; {UNKNOWN}: a run does not hold the figure by scenes, or lacks forecasts)."
    )
    for name, count in zip((a, b), seeds, strict=True):
        if count == 1:
            note += f" One training of {name}: how its trainings vary is not included."
    rows = tuple(
        (
            one.figure,
            mean_and_deviation(one.a),
            mean_and_deviation(one.b),
            signed(one.difference, 3),
            bounds(one.interval),
        )
        for one in figures
    )
    return Table(f"{a} and {b}", note, ("figure", a, b, f"{b} − {a}", "95 % interval"), rows)


def _trainings(
    name: str, results: Sequence[BenchmarkResults], instances: Sequence[Instances]
) -> list[tuple[BenchmarkModelResult, Instances]]:
    """Return a method's results in the runs that have it.

    Raises:
        BenchmarkError: a run has several versions.
    """
    found = []
    for one, own in zip(results, instances, strict=True):
        models = [model for model in one.models if model.name == name]
        if len(models) > 1:
            raise BenchmarkError(f"a run has {', '.join(model.key for model in models)}: give one a run")
        found += [(model, own) for model in models]
    return found


def mean_and_deviation(values: Sequence[float], digits: int = 3) -> str:
    """Return a mean ± the standard deviation of several values."""
    deviation = f" ± {number(float(np.std(values, ddof=1)), digits)}" if len(values) > 1 else ""
    return number(float(np.mean(values)), digits) + deviation
