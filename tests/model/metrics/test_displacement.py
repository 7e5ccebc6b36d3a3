import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from model.arrays import Floats
from model.metrics import displacement

coordinates = st.floats(-1e6, 1e6)
paths = arrays(np.float64, (2, 12, 2), elements=coordinates)


def test_by_hand() -> None:
    truth = np.zeros((1, 4, 2))
    forecast = np.array([[[3.0, 4.0], [0.0, 1.0], [-6.0, 8.0], [0.0, 0.0]]])
    errors = displacement.displacement_m(forecast, truth)
    np.testing.assert_array_equal(errors, [[5, 1, 10, 0]])
    assert displacement.ade_m(errors, 1).tolist() == [3]
    assert displacement.fde_m(errors, 1).tolist() == [1]
    assert displacement.ade_m(errors, 1.5).tolist() == [pytest.approx(16 / 3)]
    assert displacement.ade_m(errors, 2).tolist() == [4]
    assert displacement.fde_m(errors, 2).tolist() == [0]
    assert displacement.horizons_within(12) == (1, 2, 3, 4, 5, 6)
    assert displacement.horizons_within(5) == (1, 2)


@pytest.mark.parametrize("horizon", [0, -1, 0.3, float("nan"), 6.5])
def test_a_horizon_is_whole_steps_within_the_forecast(horizon: float) -> None:
    with pytest.raises(ValueError, match=r"horizon|reach"):
        displacement.ade_m(np.zeros((1, 12)), horizon)


@given(paths)
def test_ade_lies_between_the_errors_and_a_shift_is_the_error(path: Floats) -> None:
    errors = displacement.displacement_m(path, path[::-1])
    for horizon in displacement.HORIZONS_S:
        ade = displacement.ade_m(errors, horizon)
        assert (ade <= errors.max(axis=1) * (1 + 1e-12)).all()
        assert (ade >= errors.min(axis=1) * (1 - 1e-12)).all()
    np.testing.assert_allclose(displacement.displacement_m(path + np.array([3.0, 4.0]), path), 5, atol=1e-8)


def test_what_is_not_finite_is_nan_and_only_where_it_counts() -> None:
    forecast, truth = np.zeros((2, 12, 2)), np.zeros((2, 12, 2))
    truth[0, 5, 0], truth[1, 11, 1], forecast[1, 11, 1] = np.nan, np.inf, np.inf
    errors = displacement.displacement_m(forecast, truth)
    np.testing.assert_array_equal(np.argwhere(np.isnan(errors)), [[0, 5], [1, 11]])
    np.testing.assert_array_equal(displacement.ade_m(errors, 2), [0, 0])
    np.testing.assert_array_equal(displacement.fde_m(errors, 3), [np.nan, 0])
    np.testing.assert_array_equal(displacement.ade_m(errors, 6), [np.nan, np.nan])


@given(arrays(np.float64, (2, 5, 12, 2), elements=st.floats(-100, 100)))
def test_expected_errors_are_means_over_the_samples(samples: Floats) -> None:
    truth = np.ones((2, 12, 2))
    each = [displacement.displacement_m(samples[:, s], truth) for s in range(5)]
    for horizon in (1, 6):
        np.testing.assert_allclose(
            displacement.ade_m(displacement.expected_displacement_m(samples, truth), horizon),
            np.mean([displacement.ade_m(e, horizon) for e in each], axis=0),
        )
        np.testing.assert_allclose(
            displacement.fde_m(displacement.expected_displacement_m(samples, truth), horizon),
            np.mean([displacement.fde_m(e, horizon) for e in each], axis=0),
        )
