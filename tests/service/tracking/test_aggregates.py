"""Aggregates by model."""

import numpy as np
import pytest

from service.tracking.aggregates import CONVERGENCES, DISPERSIONS, ERRORS, Aggregates
from service.tracking.metrics import instant_metrics
from service.tracking.store.records import COMPLETE, SETTLED
from tests.service.tracking.test_metrics import instants


def test_sets_are_aggregated_by_model() -> None:
    made = instants(400)
    names = ["cab@1", "kalman@1"] * 200
    made["flags"][::4] = COMPLETE | SETTLED  # counted before
    made["flags"][1::4] = 0
    aggregates = Aggregates()
    aggregates.add(instant_metrics(made.tobytes()), names, newly_only=True)
    assert {name: one.instants for name, one in aggregates.models.items()} == {"cab@1": 100, "kalman@1": 100}
    own = instant_metrics(made[2::4].tobytes())
    cab = aggregates.models["cab@1"]
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
    aggregates = Aggregates()
    aggregates.add(instant_metrics(made.tobytes()), ["m@1"] * 4, newly_only=False)
    assert aggregates.models["m@1"].instants == 2
