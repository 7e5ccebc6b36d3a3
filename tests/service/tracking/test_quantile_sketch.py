"""Quantiles and counts of the sketches against the exact ones."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from model.arrays import Floats
from service.tracking.quantile_sketch import QuantileSketches

QUANTILES = (0.0, 0.1, 0.5, 0.9, 0.99, 1.0)


@given(arrays(np.float64, st.integers(1, 300), elements=st.floats(1e-3, 1e5)))
def test_quantiles_are_within_one_percent(values: Floats) -> None:
    sketches = QuantileSketches(2)
    sketches.add(np.stack([values, values * 0], axis=1))
    summary = sketches.summarize(0, QUANTILES)
    exact = np.quantile(values, QUANTILES, method="inverted_cdf")
    np.testing.assert_allclose(summary.quantiles, exact, rtol=0.0101)
    assert summary.count == len(values)
    assert summary.mean == pytest.approx(values.mean())
    assert sketches.summarize(1, QUANTILES).quantiles.tolist() == [0.0] * len(QUANTILES)


@given(arrays(np.float64, st.integers(0, 200), elements=st.floats(0, 1e7)), st.floats(1e-3, 1e5))
def test_numbers_up_to_a_bound(values: Floats, bound: float) -> None:
    sketches = QuantileSketches(1)
    sketches.add(values[:, None])
    (count,) = sketches.count_up_to(0, np.array([bound]))
    assert (values <= bound).sum() <= count <= (values <= bound * 1.0203).sum()


def test_halves_of_seconds_are_counted_where_they_belong() -> None:
    sketches = QuantileSketches(1)
    values: Floats = 0.5 * np.arange(13, dtype=np.float64)
    sketches.add(values[:, None])
    assert sketches.count_up_to(0, values).tolist() == list(range(1, 14))


def test_an_empty_distribution() -> None:
    summary = QuantileSketches(1).summarize(0, (0.5,))
    assert (summary.count, summary.mean, summary.quantiles.tolist()) == (0, 0.0, [0.0])
