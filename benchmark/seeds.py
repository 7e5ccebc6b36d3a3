"""Comparison of two methods over trainings with several seeds.

Each training is judged by a run of its own on the same pairs. The 95 % intervals are percentile bootstraps
over seeds and scenes at once: each of ``RESAMPLES`` resamples draws as many trainings of each method and as
many scenes as there are. So they hold what a single training does not show: that another seed would have
come to another figure. Deviations of S drawn trainings from their mean are widened by √(S / (S − 1)), since
resamples of few vary too little (Efron and Tibshirani 1993, chapter 5); with three trainings the interval
still is a little narrow.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark.compare import (
    KEY_FIGURES,
    LEVEL,
    RESAMPLES,
    SEED,
    bounds,
    percentile_interval,
    resamples,
)
from benchmark.errors import BenchmarkError
from benchmark.results import PER_INSTANCE, BenchmarkModelResult, BenchmarkResults, Instances
from model.arrays import Floats, Ints
from model.evaluation.tables import UNKNOWN, Table, number, signed

_SETTINGS = ("pairs", "plan", "protocol", "samples", "draws")
"""Settings that the runs must share."""


@dataclass(frozen=True)
class SeedFigure:
    """One figure of two methods over their trainings."""

    figure: str
    a: tuple[float, ...]
    """Figure of each training of A."""
    b: tuple[float, ...]
    interval: tuple[float, float]
    """95 % interval of the difference of the means, B − A; NaN where there are no figures of each pair."""

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
    instances = [Instances.read(run, one.pairs) for run, one in zip(runs, results, strict=True)]
    scenes = next((one.scenes for one in instances if one.scenes is not None), None)
    trainings = [_trainings(name, results, instances) for name in (a, b)]
    for name, found in zip((a, b), trainings, strict=True):
        if not found:
            raise BenchmarkError(f"no run has {name}")
    figures = []
    for figure, metric in KEY_FIGURES.items():
        values = [tuple(model.metrics.get(metric, math.nan) for model, _ in one) for one in trainings]
        if not np.isfinite(np.concatenate(values)).all():
            continue
        interval = (math.nan, math.nan)
        each = [[own.figures.get(f"{model.key}/{metric}") for model, own in one] for one in trainings]
        known = [[values for values in one if values is not None] for one in each]
        if scenes is not None and metric in PER_INSTANCE and list(map(len, known)) == list(map(len, each)):
            interval = seed_interval(np.stack(known[0]), np.stack(known[1]), scenes)
        figures.append(SeedFigure(figure, values[0], values[1], interval))
    return figures


def seed_interval(a: Floats, b: Floats, scenes: Ints) -> tuple[float, float]:
    """Return the 95 % interval of the mean of B − that of A over trainings and pairs.

    Args:
        a: [S, N], a figure of N pairs by S trainings; NaN where missing.
        b: [R, N], likewise.
        scenes: [N], index of each pair's scene.

    Returns:
        Lower and upper bound; NaN for fewer than two scenes. With a single training of each method it is the
        interval over scenes.
    """
    known = np.isfinite(a).all(axis=0) & np.isfinite(b).all(axis=0)
    distinct, members = np.unique(scenes[known], return_inverse=True)
    count = len(distinct)
    if count < 2:
        return math.nan, math.nan
    generator = np.random.default_rng(SEED)
    drawn = resamples(generator, count)
    pairs = drawn @ np.bincount(members)
    means = []
    for values in (a[:, known], b[:, known]):
        sums = np.stack([np.bincount(members, one, minlength=count) for one in values])  # [S, scenes]
        trainings = len(values)
        each = (drawn @ sums.T) / pairs[:, None]  # [RESAMPLES, S]
        weights = resamples(generator, trainings)
        center = each.mean(axis=1)
        deviation = (each * weights).sum(axis=1) / trainings - center
        means.append(center + deviation * math.sqrt(trainings / max(trainings - 1, 1)))
    return percentile_interval(means[1] - means[0])


def table(figures: Sequence[SeedFigure], a: str, b: str) -> Table:
    """Return the comparison as a table."""
    seeds = [len(figures[0].a), len(figures[0].b)] if figures else [0, 0]
    note = (
        f"Means ± standard deviations over {seeds[0]} and {seeds[1]} trainings; {b} − {a} with its "
        f"{100 * LEVEL:g} % interval by bootstrap over trainings and scenes ({RESAMPLES} resamples, seed "
        f"{SEED}; {UNKNOWN}: the figure is not one of single pairs)."
    )
    rows = tuple(
        (one.figure, _spread(one.a), _spread(one.b), signed(one.difference, 3), bounds(one.interval))
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


def _spread(values: Sequence[float]) -> str:
    deviation = f" ± {number(float(np.std(values, ddof=1)), 3)}" if len(values) > 1 else ""
    return number(float(np.mean(values)), 3) + deviation
