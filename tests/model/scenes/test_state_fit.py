"""The fit of states by itself; ``test_resample`` tests what becomes of it."""

import numpy as np
import pytest

from model.arrays import Floats
from model.scenes.observations import Observations
from model.scenes.state_fit import WINDOW, fit_states
from tests.model.builders import observations

NOW = 1_700_000_000.0


def straight(hertz: float, speed: float = 8.0, seconds: float = 3.0) -> Observations:
    times = NOW - np.arange(round(seconds * hertz), -1, -1) / hertz
    position = np.stack([speed * (times - NOW), np.zeros(len(times))], axis=1)
    return observations([{"time": times, "position": position}])


def times(*ago: float) -> Floats:
    return NOW - np.array([ago])


@pytest.mark.parametrize(("hertz", "share"), [(2.0, 0.0), (10.0, 1.0), (20.0, 1.0)])
def test_only_dense_observations_are_fitted(hertz: float, share: float) -> None:
    assert fit_states(straight(hertz), times(1.0, 0.5, 0.0)).share.tolist() == [[share] * 3]


def test_straight_motion_is_found_again() -> None:
    fitted = fit_states(straight(10.0), times(1.0, 0.0))
    np.testing.assert_allclose(fitted.position[0], [[-8.0, 0.0], [0.0, 0.0]], atol=0.01)
    np.testing.assert_allclose(fitted.velocity[0], [[8.0, 0.0]] * 2, atol=0.05)
    np.testing.assert_allclose(fitted.course[0], 0.0, atol=1e-6)
    assert np.isnan(fitted.heading).all()  # none is given


def test_observations_outside_the_window_do_not_count() -> None:
    plain = straight(10.0)
    moved = straight(10.0)
    moved.position[:, moved.time[0] < NOW - WINDOW] += 50.0
    one, other = (fit_states(obs, times(0.0)) for obs in (plain, moved))
    np.testing.assert_allclose(one.velocity, other.velocity, atol=1e-6)
    near = straight(10.0)
    near.position[:, -3] += 0.5
    assert np.abs(fit_states(near, times(0.0)).velocity - one.velocity).max() > 1e-3
