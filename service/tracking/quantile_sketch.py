"""Quantile sketches: distributions of many numbers in constant memory."""

from dataclasses import dataclass

import numpy as np

from model.arrays import Floats, Ints

_ACCURACY = 0.01
_GAMMA = (1 + _ACCURACY) / (1 - _ACCURACY)
_MIN, _MAX = 1e-4, 1e6
"""Bounds of the bins: smaller numbers count as 0, greater ones as the maximum."""
_LOG_GAMMA = np.log(_GAMMA)
_FIRST = int(np.ceil(np.log(_MIN) / _LOG_GAMMA))
_BINS = int(np.ceil(np.log(_MAX) / _LOG_GAMMA)) - _FIRST + 2
_VALUES = np.concatenate([[0.0], 2 / (_GAMMA + 1) * _GAMMA ** (_FIRST + np.arange(_BINS - 1))])


@dataclass(frozen=True)
class Distribution:
    """Summary of one distribution."""

    count: int
    mean: float
    quantiles: Floats
    """Requested quantiles, to 1 % of their value."""


class QuantileSketches:
    """F distributions of numbers ≥ 0, updated together.

    The bins are logarithmic, which keeps each quantile within 1 % of its value (DDSketch, Masson et al.
    2019). The ``ddsketch`` library takes one call per number, and a Predict call has 500 of them.

    Args:
        count: F.
    """

    def __init__(self, count: int) -> None:
        self._bins: Ints = np.zeros((count, _BINS), dtype=np.int64)
        self._sums = np.zeros(count)

    def add(self, values: Floats) -> None:
        """Add one number to each distribution, N times.

        Args:
            values: [N, F], finite.
        """
        np.add.at(self._bins, (np.arange(values.shape[1])[None, :], _bin(values)), 1)
        self._sums += values.sum(axis=0)

    def summarize(self, index: int, quantiles: tuple[float, ...]) -> Distribution:
        """Return the summary of one distribution; all zeros if it is empty.

        Args:
            index: number of the distribution.
            quantiles: each in [0, 1].
        """
        bins = self._bins[index]
        count = int(bins.sum())
        if not count:
            return Distribution(0, 0.0, np.zeros(len(quantiles)))
        ranks = np.ceil(np.array(quantiles) * count).clip(1, count)
        return Distribution(
            count, float(self._sums[index]) / count, _VALUES[np.searchsorted(bins.cumsum(), ranks)]
        )

    def count_up_to(self, index: int, bounds: Floats) -> Ints:
        """Return how many numbers are at most each bound, [B].

        Numbers up to 2 % above a bound may be included.

        Args:
            index: number of the distribution.
            bounds: [B].
        """
        counts: Ints = self._bins[index].cumsum()[_bin(bounds)]
        return counts

    def sum(self, index: int) -> float:
        """Return the sum of all numbers of a distribution."""
        return float(self._sums[index])


def _bin(values: Floats) -> Ints:
    with np.errstate(divide="ignore"):
        exponents = np.ceil(np.log(values) / _LOG_GAMMA)
    bins: Ints = np.clip(exponents - (_FIRST - 1), 0, _BINS - 1).astype(np.int64)
    return bins
