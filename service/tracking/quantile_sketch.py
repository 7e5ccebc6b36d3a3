"""Distributions of many numbers, in little room and for many at once."""

from dataclasses import dataclass

import numpy as np

from model.arrays import Floats, Ints

_ACCURACY = 0.01
_GAMMA = (1 + _ACCURACY) / (1 - _ACCURACY)
_LEAST, _MOST = 1e-4, 1e6
"""What is smaller counts as 0, what is greater as that."""
_LOG_GAMMA = np.log(_GAMMA)
_FIRST = int(np.ceil(np.log(_LEAST) / _LOG_GAMMA))
_BINS = int(np.ceil(np.log(_MOST) / _LOG_GAMMA)) - _FIRST + 2
_VALUES = np.concatenate([[0.0], 2 / (_GAMMA + 1) * _GAMMA ** (_FIRST + np.arange(_BINS - 1))])


@dataclass(frozen=True)
class Spread:
    """One distribution."""

    count: int
    mean: float
    quantiles: Floats
    """Those that were asked for, to 1 % of their value."""


class Sketches:
    """F distributions of numbers ≥ 0 side by side: logarithmic bins, which hold every quantile to 1 % of its
    value (DDSketch, Masson et al. 2019). The library of that name takes one call a number, and Predict has
    500 of them.

    Args:
        figures: F.
    """

    def __init__(self, figures: int) -> None:
        self._bins: Ints = np.zeros((figures, _BINS), dtype=np.int64)
        self._sums = np.zeros(figures)

    def add(self, values: Floats) -> None:
        """Counts numbers.

        Args:
            values: [N, F], finite.
        """
        np.add.at(self._bins, (np.arange(values.shape[1])[None, :], _bin(values)), 1)
        self._sums += values.sum(axis=0)

    def spread(self, figure: int, quantiles: tuple[float, ...]) -> Spread:
        """One distribution as it is; all zeros when it is empty.

        Args:
            figure: its number.
            quantiles: each in [0, 1].
        """
        bins = self._bins[figure]
        count = int(bins.sum())
        if not count:
            return Spread(0, 0.0, np.zeros(len(quantiles)))
        ranks = np.ceil(np.array(quantiles) * count).clip(1, count)
        return Spread(
            count, float(self._sums[figure]) / count, _VALUES[np.searchsorted(bins.cumsum(), ranks)]
        )

    def up_to(self, figure: int, bounds: Floats) -> Ints:
        """How many numbers are at most each bound; one that is up to 2 % above it may be among them.

        Args:
            figure: its number.
            bounds: [B].
        """
        counts: Ints = self._bins[figure].cumsum()[_bin(bounds)]
        return counts

    def sum(self, figure: int) -> float:
        """Of all numbers of a distribution."""
        return float(self._sums[figure])


def _bin(values: Floats) -> Ints:
    with np.errstate(divide="ignore"):
        exponents = np.ceil(np.log(values) / _LOG_GAMMA)
    bins: Ints = np.clip(exponents - (_FIRST - 1), 0, _BINS - 1).astype(np.int64)
    return bins
