"""Intervals by bootstrap over scenes and trainings: by hand, and against the normal distribution."""

import math

import numpy as np
import pytest

from benchmark.bootstrap import Ratio, difference_interval, mean_interval
from model.arrays import Floats, Ints

PAIRS = 40
SCENES = np.repeat(np.arange(10), 4)


def figures(seed: int, mean: float) -> Floats:
    return np.random.default_rng(seed).normal(mean, 1.0, PAIRS)


def means(trainings: Floats, scenes: Ints = SCENES) -> list[Ratio]:
    """A mean over pairs by each training."""
    return [Ratio.of(values, np.ones(len(values)), scenes) for values in trainings]


def test_the_interval_is_a_bootstrap_over_scenes_by_hand() -> None:
    """Two scenes give three means: both times the first, one of each, both times the second."""
    values, scenes = np.array([1.0, 1.0, 1.0, 5.0]), np.array([3, 3, 3, 7])
    assert mean_interval(values, scenes) == (1.0, 5.0)
    three = mean_interval(np.array([0.0, 0.0, 6.0]), np.array([0, 1, 2]))
    # All three are the last scene with probability 1/27 > 0.025, none is with 8/27
    assert three == (0.0, 6.0)


def test_the_interval_of_a_ratio_by_hand() -> None:
    """As above, with the sums 3 and 5 over 2 and 0; twice the second scene has no ratio and is left out."""
    values, scenes = np.array([1.0, 2.0, 5.0]), np.array([3, 3, 7])
    assert mean_interval(values, scenes, np.array([1.0, 1.0, 0.0])) == (1.5, 4.0)
    assert mean_interval(values, scenes, np.ones(3)) == mean_interval(values, scenes)
    assert np.isnan(mean_interval(values, scenes, np.zeros(3))).all()


def test_the_interval_of_many_scenes_is_that_of_the_normal_distribution() -> None:
    """Scenes of 4 equal pairs: pairs taken as independent would halve the interval."""
    scenes = np.repeat(np.arange(400), 4)
    values = np.repeat(np.random.default_rng(5).normal(1.0, 2.0, 400), 4)
    low, high = mean_interval(values, scenes)
    error = values[::4].std() / 20
    assert low == pytest.approx(values.mean() - 1.96 * error, abs=0.2 * error)
    assert high == pytest.approx(values.mean() + 1.96 * error, abs=0.2 * error)
    assert mean_interval(values, scenes) == (low, high)
    order = np.random.default_rng(6).permutation(len(values))
    assert mean_interval(values[order], scenes[order]) == pytest.approx((low, high))


def test_one_scene_has_no_interval() -> None:
    for scenes in ([], [4, 4]):
        assert np.isnan(mean_interval(np.ones(len(scenes)), np.array(scenes, dtype=np.int64))).all()


def test_a_single_training_has_the_interval_over_scenes() -> None:
    a, b = figures(0, 8.0), figures(1, 7.0)
    low, high = difference_interval(means(a[None]), means(b[None]))
    assert (low, high) == pytest.approx(mean_interval(b - a, SCENES), abs=0.1)


def test_trainings_that_differ_widen_the_interval() -> None:
    a, b = np.stack([figures(0, 8.0)] * 3), np.stack([figures(1, 7.0)] * 3)
    alike = difference_interval(means(a), means(b))
    apart = difference_interval(means(a), means(b + np.array([[-1.0], [0.0], [1.0]])))
    assert apart[0] < alike[0] - 0.3
    assert apart[1] > alike[1] + 0.3


def test_constants_by_hand() -> None:
    a, b = np.full((2, PAIRS), 8.0), np.full((3, PAIRS), 7.0)
    assert difference_interval(means(a), means(b)) == pytest.approx((-1.0, -1.0))
    b[1] = 10.0
    low, high = difference_interval(means(a), means(b))
    wider = math.sqrt(3 / 2)  # of the three drawn trainings, none or all are the second one
    assert low == pytest.approx(0.0 - wider)
    assert high == pytest.approx(0.0 + 2 * wider)


def test_one_scene_tells_no_interval() -> None:
    one = np.zeros(PAIRS, dtype=np.int64)
    a, b = means(figures(0, 8.0)[None], one), means(figures(1, 7.0)[None], one)
    assert np.isnan(difference_interval(a, b)).all()


def test_values_that_are_missing_count_for_nothing() -> None:
    ratio = Ratio.of(np.array([1.0, np.nan, 4.0, 5.0]), np.ones(4), np.array([0, 0, 1, 1]))
    assert (ratio.sums.tolist(), ratio.divisors.tolist()) == ([1.0, 9.0], [1.0, 2.0])


def test_the_difference_of_ratios_by_hand() -> None:
    """Sums 3 and 5 over 1 and 3, in two scenes: twice the first, one of each, twice the second."""
    a = Ratio(np.array([3.0, 5.0]), np.array([1.0, 3.0]))
    b = Ratio(np.zeros(2), a.divisors)
    assert difference_interval([a], [b]) == pytest.approx((-3.0, -5 / 3))


def test_resamples_without_a_divisor_are_left_out() -> None:
    """A resample of the third scene alone has no ratio."""
    divisors = np.array([2.0, 1.0, 0.0])
    a, b = Ratio(np.array([4.0, 1.0, 0.0]), divisors), Ratio(np.zeros(3), divisors)
    low, high = difference_interval([a], [b])
    assert (low, high) == (-2.0, -1.0)


def test_one_scene_with_a_divisor_tells_no_interval() -> None:
    divisors = np.array([2.0, 0.0, 0.0])
    a, b = Ratio(np.array([4.0, 0.0, 0.0]), divisors), Ratio(np.zeros(3), divisors)
    assert np.isnan(difference_interval([a], [b])).all()


def test_figures_of_different_pairs_have_no_interval() -> None:
    a, b = Ratio(np.ones(3), np.ones(3)), Ratio(np.ones(3), np.array([1.0, 2.0, 1.0]))
    assert np.isnan(difference_interval([a], [b])).all()
