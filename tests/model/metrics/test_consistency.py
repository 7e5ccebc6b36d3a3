"""Arrangement by age, dispersion and convergence."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.arrays import Ints
from model.metrics.consistency import (
    RANGES_M,
    complete,
    convergence_s,
    convergence_steps,
    dispersion,
    errors_by_age_m,
    forecasts_by_age,
)


def test_forecasts_by_age_by_hand() -> None:
    """Element [f, t − 1] says of itself when it was made and for when."""
    made, steps = np.array([3, 4, 6]), 3
    ahead = np.arange(1, steps + 1)
    forecasts = np.stack(np.broadcast_arrays(made[:, None], made[:, None] + ahead), axis=-1).astype(float)
    instants = np.array([2, 3, 5, 6, 7, 9, 10])
    by_age = forecasts_by_age(made, forecasts, instants)
    nan = np.nan
    np.testing.assert_array_equal(
        by_age[..., 0],
        [[nan] * 3, [nan] * 3, [4, 3, nan], [nan, 4, 3], [6, nan, 4], [nan, nan, 6], [nan] * 3],
    )
    there = np.isfinite(by_age[..., 0])
    np.testing.assert_array_equal(by_age[..., 1][there], np.repeat(instants, 3).reshape(-1, 3)[there])
    assert not complete(by_age).any()


@given(st.sets(st.integers(-5, 40), max_size=30), st.integers(0, 100))
def test_forecasts_by_age_is_a_look_up(frames: set[int], seed: int) -> None:
    made: Ints = np.array(sorted(frames), dtype=np.int64)
    forecasts = np.random.default_rng(seed).normal(size=(len(made), 12, 2))
    instants = np.arange(-6, 55)
    by_age = forecasts_by_age(made, forecasts, instants)
    for p, instant in enumerate(instants.tolist()):
        for age in range(1, 13):
            if instant - age in frames:
                row = sorted(frames).index(instant - age)
                assert by_age[p, age - 1].tolist() == forecasts[row, age - 1].tolist()
            else:
                assert np.isnan(by_age[p, age - 1]).all()


def test_bad_frames_are_refused() -> None:
    forecasts = np.zeros((2, 12, 2))
    for made in ([1, 1], [2, 1]):
        with pytest.raises(ValueError, match="ascend"):
            forecasts_by_age(np.array(made), forecasts, np.arange(3))
    with pytest.raises(ValueError, match="as many"):
        forecasts_by_age(np.array([1]), forecasts, np.arange(3))


def test_dispersion_by_hand() -> None:
    """Around (0, 0) at distances 1, 1, 3, 3."""
    one = np.array([[1.0, 0], [-1, 0], [0, 3], [0, -3]])
    incomplete = np.where(np.arange(4)[:, None] == 2, np.nan, one)
    points = dispersion(np.stack([one + np.array([500, -700]), incomplete, 0 * one]))
    np.testing.assert_allclose(points.std_m, [1, np.nan, 0], atol=1e-12)
    np.testing.assert_allclose(points.mean_m, [2, np.nan, 0])
    np.testing.assert_allclose(points.rms_m, [np.sqrt(5), np.nan, 0])
    assert points.complete.tolist() == [True, False, True]
    assert dispersion(np.zeros((0, 12, 2))).std_m.shape == (0,)


@settings(deadline=None)
@given(st.integers(0, 10_000))
def test_dispersion_ignores_place_direction_and_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    by_age = rng.normal(size=(5, 12, 2))
    base = dispersion(by_age)
    np.testing.assert_allclose(base.rms_m**2, base.mean_m**2 + base.std_m**2)
    assert (base.std_m <= base.rms_m).all()
    angle = rng.uniform(0, 6)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = (by_age @ turn + rng.uniform(-1e5, 1e5, 2))[:, rng.permutation(12)]
    for one, other in zip(base[:3], dispersion(moved)[:3], strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8)
    np.testing.assert_allclose(dispersion(3 * by_age).std_m, 3 * base.std_m)


def test_convergence_by_hand() -> None:
    errors = np.array(
        [
            [0.1, 0.2, 0.5, 0.1],  # the third is off, so the fourth does not count
            [0.3, 0.1, 0.1, 0.1],
            [0.0, 0.0, 0.0, 0.0],
            [0.1, 0.1, np.nan, 0.1],
            [9.0, np.nan, 0.1, 0.1],
        ]
    )
    np.testing.assert_array_equal(convergence_steps(errors, 0.2), [2, 0, 4, np.nan, np.nan])
    np.testing.assert_array_equal(convergence_s(errors, 0.2), [1, 0, 2, np.nan, np.nan])
    np.testing.assert_array_equal(convergence_s(errors, 0.5), [2, 2, 2, np.nan, np.nan])


@given(st.integers(0, 10_000))
def test_convergence_grows_with_the_range(seed: int) -> None:
    rng = np.random.default_rng(seed)
    by_age = rng.normal(size=(20, 12, 2)) * np.arange(1, 13)[:, None]
    truth = rng.normal(size=(20, 2)) * 0.1
    errors = errors_by_age_m(by_age, truth)
    np.testing.assert_allclose(errors, np.linalg.norm(by_age - truth[:, None], axis=-1))
    near, middle, far = (convergence_steps(errors, r) for r in RANGES_M)
    assert ((near <= middle) & (middle <= far)).all()
    for row, steps in zip(errors, middle.astype(int), strict=True):
        assert (row[:steps] <= 1.0).all()
        assert steps == 12 or row[steps] > 1.0
    truth[3] = np.nan
    assert np.isnan(convergence_steps(errors_by_age_m(by_age, truth), 5.0)).nonzero()[0].tolist() == [3]
