import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from model.baselines.physics import baselines
from model.metrics.displacement import ade_m, displacement_m
from model.metrics.oracle import PHYSICS, Criterion, physics_oracle


def test_it_chooses_from_the_physics_baselines() -> None:
    assert [model.info.name for model in baselines()] == list(PHYSICS)


def test_by_hand() -> None:
    """Errors (0, 5), (3, 3), (3, 3): the mean prefers the first, the root mean square the second."""
    truth = np.zeros((1, 2, 2))
    forecasts = np.array([[[[0, 0], [5, 0]], [[0, 3], [3, 0]], [[3, 0], [0, 3]]]], dtype=np.float64)
    by_mean = physics_oracle(forecasts, truth)
    assert by_mean.choice.tolist() == [0]
    np.testing.assert_array_equal(by_mean.trajectory[0], forecasts[0, 0])
    assert physics_oracle(forecasts, truth, Criterion.RMS_DISTANCE).choice.tolist() == [1]


@given(st.integers(0, 10_000))
def test_no_forecast_is_nearer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    forecasts, truth = rng.normal(size=(6, 4, 12, 2)), rng.normal(size=(6, 12, 2))
    chosen = physics_oracle(forecasts, truth)
    ade = ade_m(displacement_m(forecasts, truth[:, None]), 6)
    np.testing.assert_array_equal(ade_m(displacement_m(chosen.trajectory, truth), 6), ade.min(axis=1))


def test_what_is_missing() -> None:
    forecasts = np.zeros((4, 2, 3, 2))
    forecasts[:, 1] = 1
    truth = np.ones((4, 3, 2))
    forecasts[1, 1, 0, 0] = np.nan  # the better one cannot be chosen
    truth[2, 1:] = np.nan  # chosen by the first step alone
    truth[3] = np.nan
    chosen = physics_oracle(forecasts, truth)
    assert chosen.choice.tolist() == [1, 0, 1, -1]
    assert np.isnan(chosen.trajectory[3]).all()
    forecasts[0] = np.nan
    assert physics_oracle(forecasts, truth).choice[0] == -1
