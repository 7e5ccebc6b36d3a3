"""Settled sets, summed by model."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Floats, Ints
from model.metrics.convergence import RANGES_M
from service.tracking.metrics import Figures
from service.tracking.quantile_sketch import Sketches, Spread
from service.tracking.store.records import AGES

DISPERSIONS = range(3)
"""Numbers of the figures that are dispersion, in the order of ``model.metrics.dispersion.Dispersion``, m."""
CONVERGENCES = range(DISPERSIONS.stop, DISPERSIONS.stop + len(RANGES_M))
"""C(τ) for each of ``RANGES_M``, s."""
ERRORS = range(CONVERGENCES.stop, CONVERGENCES.stop + AGES)
"""Displacement error by age, m."""


class ModelSums:
    """Of one model: the figures numbered above."""

    def __init__(self) -> None:
        self._sketches = Sketches(ERRORS.stop)
        self._nearest: Ints = np.zeros(AGES, dtype=np.int64)
        self.instants = 0
        """Sets that were counted."""

    def add(self, figures: Figures, rows: Ints) -> None:
        """Counts sets.

        Args:
            figures: among others of these.
            rows: [n], which; all complete.
        """
        apart = np.stack(figures.dispersion[: len(DISPERSIONS)], axis=1)
        values = np.concatenate([apart, figures.convergence_s, figures.errors_m], axis=1)[rows]
        self._sketches.add(values)
        self._nearest += figures.nearest[rows].sum(axis=0)
        self.instants += len(rows)

    def spread(self, figure: int, quantiles: tuple[float, ...]) -> Spread:
        """The distribution of one of the figures."""
        return self._sketches.spread(figure, quantiles)

    def up_to(self, figure: int, bounds: Floats) -> Ints:
        """[B], how many sets have at most each bound [B] of a figure."""
        return self._sketches.up_to(figure, bounds)

    def sum(self, figure: int) -> float:
        """Of one of the figures, over all sets."""
        return self._sketches.sum(figure)

    def nearest(self, age: int) -> float:
        """In what share of the sets the most likely mode was the nearest one, by age counted from 0."""
        return float(self._nearest[age]) / self.instants if self.instants else 0.0


class Sums:
    """Sums by model, name@version."""

    def __init__(self) -> None:
        self.models: dict[str, ModelSums] = {}

    def add(self, figures: Figures, series: Sequence[str], newly_only: bool) -> None:
        """Counts sets.

        Args:
            figures: P instants.
            series: P, whose forecasts.
            newly_only: those that were settled just now, not all that are settled.
        """
        counted = figures.newly if newly_only else figures.settled & figures.complete
        names = np.array(series, dtype=object)
        for name in dict.fromkeys(names[counted]):
            rows = np.flatnonzero(counted & (names == name))
            self.models.setdefault(name, ModelSums()).add(figures, rows)
