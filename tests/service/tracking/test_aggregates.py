"""Distributions, and sums by model."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from model.arrays import Floats
from service.tracking.aggregates import CONVERGENCES, DISPERSIONS, ERRORS, Aggregates
from service.tracking.metrics import instant_metrics
from service.tracking.quantile_sketch import QuantileSketches
from service.tracking.store.records import COMPLETE, SETTLED
from tests.service.tracking.test_metrics import instants

QUANTILES = (0.0, 0.1, 0.5, 0.9, 0.99, 1.0)


@given(arrays(np.float64, st.integers(1, 300), elements=st.floats(1e-3, 1e5)))
def test_quantiles_are_within_one_percent(values: Floats) -> None:
    sketches = QuantileSketches(2)
    sketches.add(np.stack([values, values * 0], axis=1))
    spread = sketches.summarize(0, QUANTILES)
    exact = np.quantile(values, QUANTILES, method="inverted_cdf")
    np.testing.assert_allclose(spread.quantiles, exact, rtol=0.0101)
    assert spread.count == len(values)
    assert spread.mean == pytest.approx(values.mean())
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
    spread = QuantileSketches(1).summarize(0, (0.5,))
    assert (spread.count, spread.mean, spread.quantiles.tolist()) == (0, 0.0, [0.0])


def test_sets_are_summed_by_model() -> None:
    made = instants(400)
    names = ["cab@1", "kalman@1"] * 200
    made["flags"][::4] = COMPLETE | SETTLED  # counted before
    made["flags"][1::4] = 0
    sums = Aggregates()
    sums.add(instant_metrics(made.tobytes()), names, newly_only=True)
    assert {name: one.instants for name, one in sums.models.items()} == {"cab@1": 100, "kalman@1": 100}
    own = instant_metrics(made[2::4].tobytes())
    cab = sums.models["cab@1"]
    for figure, values in zip(DISPERSIONS, own.dispersion[:3], strict=True):
        assert cab.summarize(figure, ()).mean == pytest.approx(values.mean())
    for number, figure in enumerate(CONVERGENCES):
        assert cab.summarize(figure, ()).mean == pytest.approx(own.convergence_s[:, number].mean())
    for age, figure in enumerate(ERRORS):
        median = cab.summarize(figure, (0.5,))
        exact = np.quantile(own.errors_m[:, age], 0.5, method="inverted_cdf")
        assert median.quantiles[0] == pytest.approx(exact, rel=0.0101)
        assert cab.sum(figure) == pytest.approx(own.errors_m[:, age].sum())
        assert cab.nearest_share(age) == pytest.approx(own.nearest[:, age].mean())


def test_of_a_scene_all_that_is_settled_counts() -> None:
    made = instants(4)
    made["flags"] = [COMPLETE | SETTLED, COMPLETE, 0, COMPLETE | SETTLED]
    sums = Aggregates()
    sums.add(instant_metrics(made.tobytes()), ["m@1"] * 4, newly_only=False)
    assert sums.models["m@1"].instants == 2
