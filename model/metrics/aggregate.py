"""Means over many batches without keeping them."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Final

import numpy as np

from model.arrays import Floats

INFINITE: Final = 1e300
"""Values beyond it count as infinite: sums of what is below cannot overflow."""


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

    def add_values(self, values: Floats) -> None:
        known = values[~np.isnan(values)]
        self.add_parts(known[np.abs(known) <= INFINITE].tolist())
        self.count += known.size
        self.missing += values.size - known.size
        self.above += int((known > INFINITE).sum())
        self.below += int((known < -INFINITE).sum())

    def add_sum(self, other: "_Sum") -> None:
        self.add_parts(other.parts)
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
            self._sums.setdefault(name, _Sum()).add_values(np.asarray(values, dtype=np.float64))

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

    def state(self) -> dict[str, dict[str, list[float] | int]]:
        """All that is known, as JSON can hold it without loss (Python's floats come back as they were)."""
        return {name: asdict(total) for name, total in self._sums.items()}

    @classmethod
    def from_state(cls, state: Mapping[str, Mapping[str, list[float] | int]]) -> "MetricMeans":
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
                }:
                    means._sums[name] = _Sum([float(p) for p in parts], count, missing, above, below)
                case _:
                    raise ValueError(f"no saved sum: {name}")
        return means
