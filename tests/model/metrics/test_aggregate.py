import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.arrays import Floats
from model.metrics.aggregate import MetricMeans

values = st.lists(st.floats(-1e12, 1e12), min_size=1, max_size=40)


def _of(*batches: Floats) -> MetricMeans:
    means = MetricMeans()
    for batch in batches:
        means.add({"m": batch})
    return means


@settings(deadline=None)
@given(values, st.integers(0, 1000))
def test_the_mean_is_exact_however_the_batches_are_cut(given_values: list[float], seed: int) -> None:
    rng = np.random.default_rng(seed)
    all_of_them = np.array(given_values)
    exact = float(sum(map(Fraction, given_values), Fraction())) / len(given_values)
    shuffled = rng.permutation(all_of_them)
    cut = _of(*np.array_split(shuffled, rng.integers(1, 6)))
    assert _of(all_of_them).mean("m") == exact
    assert cut.mean("m") == exact
    half = len(shuffled) // 2
    one, other = _of(shuffled[:half]), _of(shuffled[half:])
    one.merge(other)
    assert one.mean("m") == exact
    assert one.count("m") == len(given_values)


def test_nothing_is_lost_between_huge_and_tiny() -> None:
    assert _of(np.array([1e16, 1.0]), np.array([-1e16, 1.0])).mean("m") == 0.5


def test_missing_values_are_counted_apart() -> None:
    means = MetricMeans()
    means.add({"a": np.array([1.0, np.nan, 3.0]), "b": np.array([np.nan])})
    means.add({"a": np.array([5.0]), "c": np.zeros(0)})
    assert means.names() == ["a", "b", "c"]
    assert (means.mean("a"), means.count("a"), means.missing("a")) == (3.0, 3, 1)
    assert (means.count("b"), means.missing("b"), means.count("c")) == (0, 1, 0)
    assert math.isnan(means.mean("b"))
    assert math.isnan(means.mean("c"))
    with pytest.raises(KeyError):
        means.mean("d")


def test_infinities_are_not_hidden() -> None:
    assert _of(np.array([1.0, np.inf]), np.array([2.0])).mean("m") == math.inf
    assert _of(np.array([1.0, -np.inf])).mean("m") == -math.inf
    assert math.isnan(_of(np.array([np.inf]), np.array([-np.inf])).mean("m"))
    assert _of(np.array([1.7e308]), np.array([1.7e308])).mean("m") == math.inf


@settings(deadline=None)
@given(st.lists(st.integers(1, 9) | st.none(), max_size=30), st.integers(0, 1000))
def test_medians_of_counts_are_exact_however_the_batches_are_cut(counts: list[int | None], seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.permutation(np.array([np.nan if count is None else count for count in counts], dtype=float))
    one, other = MetricMeans(), MetricMeans()
    for batch in np.array_split(values, 3):
        one.add({"merged_modes_90": batch, "nll": batch})
    other.add({"merged_modes_90": values})
    known = values[~np.isnan(values)]
    expected = float(np.median(known)) if len(known) else math.nan
    np.testing.assert_equal(one.medians(), {"merged_modes_90_median": expected})
    np.testing.assert_equal(other.medians(), one.medians())
    np.testing.assert_equal(one.figures(), one.means() | one.medians())
    one.merge(other)
    np.testing.assert_equal(one.medians(), other.medians())
