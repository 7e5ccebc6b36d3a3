"""Metrics of instants against those of ``model.metrics``."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.metrics.consistency import RANGES_M, convergence_s, dispersion, errors_by_age_m
from service.tracking.metrics import AGES_S, instant_metrics
from service.tracking.store.records import AGES, COMPLETE, INSTANT, MODES, NEWLY, SETTLED


def instants(count: int, seed: int = 0) -> np.ndarray:
    """Return random instants with forecasts on their lags, far from the origin, settled by this call."""
    rng = np.random.default_rng(seed)
    made = np.zeros(count, dtype=INSTANT)
    made["time"] = 1.6e9 + rng.uniform(0, 100, count)
    made["position"] = rng.uniform(-1e4, 1e4, (count, 2))
    made["made_at"] = made["time"][:, None] - AGES_S
    made["blocks"]["point"] = made["position"][:, None, None] + rng.normal(size=(count, AGES, 3, 2)) * 3
    made["blocks"]["others"] = rng.normal(size=(count, AGES, 3, MODES - 1, 2)) * 3
    made["flags"] = COMPLETE | SETTLED | NEWLY
    return made


def test_on_their_lags_forecasts_are_taken_as_they_are() -> None:
    made = instants(50)
    found = instant_metrics(made.tobytes())
    points = made["blocks"]["point"][:, :, 1]
    errors_m = errors_by_age_m(points, made["position"])
    np.testing.assert_array_equal(found.errors_m, errors_m)
    expected = dispersion(points)
    for ours, theirs in zip(found.dispersion, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for number, range_m in enumerate(RANGES_M):
        np.testing.assert_array_equal(found.convergence_s[:, number], convergence_s(errors_m, range_m))
    assert found.complete.all()
    assert found.newly.all()


def test_the_nearest_of_the_likeliest_modes() -> None:
    made = instants(200)
    found = instant_metrics(made.tobytes())
    points = made["blocks"]["point"][:, :, 1]
    others = points[:, :, None] + made["blocks"]["others"][:, :, 1]
    apart = np.linalg.norm(others - made["position"][:, None, None], axis=-1).min(axis=-1)
    np.testing.assert_array_equal(found.nearest, found.errors_m <= apart)
    assert 0.1 < found.nearest.mean() < 0.5


def test_the_only_mode_is_the_nearest() -> None:
    made = instants(3)
    made["blocks"]["others"] = np.nan
    assert instant_metrics(made.tobytes()).nearest.all()


def test_what_is_missing_is_no_number() -> None:
    made = instants(2)
    made["made_at"][0, 3] = np.nan
    made["blocks"][0, 3] = np.nan
    made["flags"][0] = 0
    found = instant_metrics(made.tobytes())
    assert np.isnan(found.errors_m[0]).tolist() == [age == 3 for age in range(AGES)]
    assert not found.nearest[0, 3]
    assert np.isnan(found.convergence_s[0]).all()
    assert np.isnan([form[0] for form in found.dispersion[:3]]).all()
    assert found.complete.tolist() == [False, True]
    assert np.isfinite(found.convergence_s[1]).all()


def test_no_instants() -> None:
    assert len(instant_metrics(b"")) == 0


@given(st.floats(-0.09, 0.09), st.integers(0, 11))
def test_off_its_lag_a_forecast_is_read_at_the_instant(late: float, age: int) -> None:
    """A straight path at any speed is met exactly, between the steps and behind the last one."""
    made = instants(1)
    speed = np.array([12.0, -5.0])
    made["made_at"][0, age] -= late
    for block, steps in enumerate((age, age + 1, age + 2)):
        path = made["position"][0] + speed * (made["made_at"][0, age] + 0.5 * steps - made["time"][0])
        made["blocks"]["point"][0, age, block] = path
        made["blocks"]["others"][0, age, block] = 2.0 + 0.5 * steps
    if age == AGES - 1:
        made["blocks"][0, age, 2] = np.nan
    found = instant_metrics(made.tobytes())
    # Within the tolerance of 0.1 ms it is not read between steps
    assert found.errors_m[0, age] == pytest.approx(0.0, abs=13 * 1e-4 + 1e-6)
    assert found.nearest[0, age]
