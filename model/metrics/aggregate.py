"""Means of metrics over many batches, without keeping the batches."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from model.arrays import Floats

INFINITE: Final = 1e300
"""Values beyond it count as infinite, so that sums cannot overflow."""
COUNTED: Final = ("merged_modes_90", "moving_merged_modes_90")
"""Metrics that are small whole numbers; the number of each value is kept, for their medians."""


@dataclass
class _Sum:
    """An exact sum, as floats that add up to it without rounding; so the order of addition is irrelevant."""

    parts: list[float] = field(default_factory=list)
    count: int = 0
    missing: int = 0
    """Number of NaN."""
    above: int = 0
    """Number of infinite values."""
    below: int = 0
    """Number of negative infinite values."""
    occurrences: list[list[float]] = field(default_factory=list)
    """For a counted metric, each value with its number of occurrences, ascending; else empty."""

    def add_values(self, values: Floats) -> None:
        known = values[~np.isnan(values)]
        self.add_parts(known[np.abs(known) <= INFINITE].tolist())
        self.count += known.size
        self.missing += values.size - known.size
        self.above += int((known > INFINITE).sum())
        self.below += int((known < -INFINITE).sum())

    def add_occurrences(self, occurrences: Iterable[Sequence[float]]) -> None:
        found: dict[float, float] = {}
        for value, times in (*self.occurrences, *occurrences):
            found[value] = found.get(value, 0) + times
        self.occurrences = [[value, times] for value, times in sorted(found.items())]

    def add_sum(self, other: "_Sum") -> None:
        self.add_parts(other.parts)
        self.add_occurrences(other.occurrences)
        self.count += other.count
        self.missing += other.missing
        self.above += other.above
        self.below += other.below

    def add_parts(self, values: list[float]) -> None:
        """Add values; ``fsum`` rounds once, and its error is the sum of all terms minus its result."""
        terms = [*self.parts, *values]
        self.parts = []
        while (part := math.fsum([*terms, *(-p for p in self.parts)])) != 0:
            self.parts.append(part)

    def mean(self) -> float:
        if not self.count or (self.above and self.below):
            return math.nan
        if self.above or self.below:
            return math.inf if self.above else -math.inf
        return math.fsum(self.parts) / self.count

    def median(self) -> float:
        if not self.occurrences:
            return math.nan
        values, times = np.array(self.occurrences).T
        middle = [(self.count - 1) // 2, self.count // 2]
        return float(values[np.searchsorted(np.cumsum(times), middle, side="right")].mean())


class MetricMeans:
    """Mean and count of each metric over batches of instances.

    Sums are exact: for the same instances the means are the same to the last bit, whatever the batches and
    their order, merged or not. NaN are counted separately; infinite values make the mean infinite.
    """

    def __init__(self) -> None:
        self._sums: dict[str, _Sum] = {}

    def add(self, batch: Mapping[str, Floats]) -> None:
        """Add instances.

        Args:
            batch: [n] (or any shape, all elements alike) by metric. Batches need not have the same metrics.
        """
        for name, values in batch.items():
            array = np.asarray(values, dtype=np.float64)
            total = self._sums.setdefault(name, _Sum())
            total.add_values(array)
            if name in COUNTED:
                found, times = np.unique(array[~np.isnan(array)], return_counts=True)
                total.add_occurrences(zip(found.tolist(), times.tolist(), strict=True))

    def merge(self, other: "MetricMeans") -> None:
        """Add the content of another instance."""
        for name, theirs in other._sums.items():
            self._sums.setdefault(name, _Sum()).add_sum(theirs)

    def names(self) -> list[str]:
        """Return the metrics seen so far, in order of first appearance."""
        return list(self._sums)

    def mean(self, name: str) -> float:
        """Return the mean of a metric over the instances that have it; NaN if none has.

        Raises:
            KeyError: no batch had that metric.
        """
        return self._sums[name].mean()

    def count(self, name: str) -> int:
        """Return the number of instances that have the metric (are not NaN)."""
        return self._sums[name].count

    def missing(self, name: str) -> int:
        """Return the number of instances with NaN."""
        return self._sums[name].missing

    def means(self) -> dict[str, float]:
        """Return the mean of each metric, by name."""
        return {name: total.mean() for name, total in self._sums.items()}

    def medians(self) -> dict[str, float]:
        """Return the medians of the counted metrics, as ``<metric>_median``; NaN if no instance has it."""
        return {f"{name}_median": self._sums[name].median() for name in COUNTED if name in self._sums}

    def figures(self) -> dict[str, float]:
        """Return means, and medians of counted metrics, by name."""
        return self.means() | self.medians()
