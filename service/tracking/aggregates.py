"""Consistency metrics of settled sets, aggregated by model."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Floats, Ints
from model.metrics.consistency import RANGES_M
from service.tracking.metrics import InstantMetrics
from service.tracking.quantile_sketch import Distribution, QuantileSketches
from service.tracking.store.records import AGES

DISPERSIONS = range(3)
"""Indices of the dispersion metrics, in the order of ``model.metrics.consistency.Dispersion``, m."""
CONVERGENCES = range(DISPERSIONS.stop, DISPERSIONS.stop + len(RANGES_M))
"""Indices of C(τ), one per range of ``RANGES_M``, s."""
ERRORS = range(CONVERGENCES.stop, CONVERGENCES.stop + AGES)
"""Indices of the displacement errors by age, m."""


class ModelAggregate:
    """Distributions of the metrics of one model, by the indices above."""

    def __init__(self) -> None:
        self._sketches = QuantileSketches(ERRORS.stop)
        self._nearest: Ints = np.zeros(AGES, dtype=np.int64)
        self.instants = 0
        """Number of aggregated sets."""

    def add(self, metrics: InstantMetrics, rows: Ints) -> None:
        """Add sets.

        Args:
            metrics: metrics of P instants.
            rows: [n], the instants to add; all complete.
        """
        dispersion = np.stack(metrics.dispersion[: len(DISPERSIONS)], axis=1)
        values = np.concatenate([dispersion, metrics.convergence_s, metrics.errors_m], axis=1)[rows]
        self._sketches.add(values)
        self._nearest += metrics.nearest[rows].sum(axis=0)
        self.instants += len(rows)

    def summarize(self, metric: int, quantiles: tuple[float, ...]) -> Distribution:
        """Return the summary of one metric."""
        return self._sketches.summarize(metric, quantiles)

    def count_up_to(self, metric: int, bounds: Floats) -> Ints:
        """Return how many sets have at most each value of a metric, [B].

        Args:
            metric: index of the metric.
            bounds: [B].
        """
        return self._sketches.count_up_to(metric, bounds)

    def sum(self, metric: int) -> float:
        """Return the sum of one metric over all sets."""
        return self._sketches.sum(metric)

    def nearest_share(self, age: int) -> float:
        """Return the share of sets in which the most likely mode was the nearest one.

        Args:
            age: index of the age, from 0.
        """
        return float(self._nearest[age]) / self.instants if self.instants else 0.0


class Aggregates:
    """Aggregates by model, ``name@version``."""

    def __init__(self) -> None:
        self.models: dict[str, ModelAggregate] = {}

    def add(self, metrics: InstantMetrics, models: Sequence[str], newly_only: bool) -> None:
        """Add settled sets.

        Args:
            metrics: metrics of P instants.
            models: [P], the model of each instant's forecasts.
            newly_only: True: only the sets that the call settled; False: all settled sets.
        """
        selected = metrics.newly if newly_only else metrics.settled & metrics.complete
        names = np.array(models, dtype=object)
        for name in dict.fromkeys(names[selected]):
            rows = np.flatnonzero(selected & (names == name))
            self.models.setdefault(name, ModelAggregate()).add(metrics, rows)
