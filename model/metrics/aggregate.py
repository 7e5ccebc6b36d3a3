"""Means over many batches without keeping them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

import numpy as np

from model.arrays import Floats

INFINITE: Final = 1e300
"""Values beyond it count as infinite: sums of what is below cannot overflow."""
COUNTED: Final = ("merged_modes_90", "moving_merged_modes_90")
"""Metrics that are small whole numbers: how often each occurs is kept, for their medians."""


@dataclass
class _Sum:
    """An exact sum: floats that add up to it without rounding, so that no order of addition matters."""

    parts: list[float] = field(default_factory=list)
    count: int = 0
    missing: int = 0
    """NaN."""
    above: int = 0
    """Infinite."""
    below: int = 0
    """Negative infinite."""
    occurrences: list[list[float]] = field(default_factory=list)
    """Of a metric that is counted: each value and how often it came, ascending; of others nothing."""

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
        """fsum rounds once; what it rounded off is the sum of all less what it gave."""
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
    """Adds batches of per-instance metrics, and gives each one's mean and count.

    Sums are exact: the means are to the last bit the same for the same instances, however they were cut into
    batches, in whatever order they came, and through whatever sequence of ``merge`` or ``state``. NaN is
    counted apart; infinite values make the mean infinite.
    """

    def __init__(self) -> None:
        self._sums: dict[str, _Sum] = {}

    def add(self, batch: Mapping[str, Floats]) -> None:
        """Adds instances.

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
        """Adds all that another one holds."""
        for name, theirs in other._sums.items():
            self._sums.setdefault(name, _Sum()).add_sum(theirs)

    def names(self) -> list[str]:
        """Metrics seen so far, in order of first sight."""
        return list(self._sums)

    def mean(self, name: str) -> float:
        """Mean of a metric over the instances that have it; NaN if none has.

        Raises:
            KeyError: no batch had that metric.
        """
        return self._sums[name].mean()

    def count(self, name: str) -> int:
        """How many instances have the metric (are not NaN)."""
        return self._sums[name].count

    def missing(self, name: str) -> int:
        """How many instances came with NaN."""
        return self._sums[name].missing

    def means(self) -> dict[str, float]:
        """Mean of each metric, by name."""
        return {name: total.mean() for name, total in self._sums.items()}

    def medians(self) -> dict[str, float]:
        """Median of each of the metrics that are counted, as ``<metric>_median``; NaN if none has it."""
        return {f"{name}_median": self._sums[name].median() for name in COUNTED if name in self._sums}

    def figures(self) -> dict[str, float]:
        """Means, and the medians that there are, by name."""
        return self.means() | self.medians()

    def state(self) -> dict[str, dict[str, Any]]:
        """All that is known, as JSON can hold it without loss (Python's floats come back as they were)."""
        return {name: asdict(total) for name, total in self._sums.items()}

    @classmethod
    def from_state(cls, state: Mapping[str, Mapping[str, Any]]) -> "MetricMeans":
        """The one that gave this ``state``.

        Raises:
            ValueError: it is not of that form.
        """
        means = cls()
        for name, saved in state.items():
            match saved:
                case {
                    "parts": list(parts),
                    "count": int(count),
                    "missing": int(missing),
                    "above": int(above),
                    "below": int(below),
                    "occurrences": list(occurrences),
                }:
                    total = means._sums[name] = _Sum([float(p) for p in parts], count, missing, above, below)
                    total.add_occurrences(occurrences)
                case _:
                    raise ValueError(f"no saved sum: {name}")
        return means
