import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.arrays import Floats
from model.metrics import multimodal

TRUTH = np.zeros((1, 2, 2))
MODES = np.array([[[[0, 3], [0, 1]], [[0, 1.5], [0, 1.9]], [[0, 2], [0, 0]]]], dtype=np.float64)
"""Mean distances 2, 1.7, 1; last 1, 1.9, 0; greatest 3, 1.9, 2."""
PROBABILITIES = np.array([[0.5, 0.2, 0.3]])


def test_by_hand() -> None:
    order = multimodal.by_probability(PROBABILITIES)
    assert order.tolist() == [[0, 2, 1]]
    for k, ade, fde, miss in ((1, 2, 1, 1), (2, 1, 0, 1), (3, 1, 0, 0), (10, 1, 0, 0)):
        assert multimodal.min_ade_m(MODES, PROBABILITIES, TRUTH, k).tolist() == [ade]
        assert multimodal.min_fde_m(MODES, PROBABILITIES, TRUTH, k).tolist() == [fde]
        assert multimodal.missed(MODES, PROBABILITIES, TRUTH, k).tolist() == [miss]


def test_brier_by_hand() -> None:
    """The nearest of the first at the end has 0.5, of more 0.3."""
    for k, expected in ((1, 1 + 0.25), (2, 0.49), (3, 0.49), (10, 0.49)):
        found = multimodal.brier_min_fde_m(MODES, PROBABILITIES, TRUTH, k)
        np.testing.assert_allclose(found, [expected])


def test_of_modes_that_end_equally_near_the_most_probable_counts() -> None:
    found = multimodal.brier_min_fde_m(MODES[:, [0, 0, 0]], PROBABILITIES, TRUTH, 3)
    np.testing.assert_allclose(found, [1 + 0.25])


def test_how_many_modes_hold_a_share() -> None:
    weights = np.array([[0.5, 0.3, 0.15, 0.05], [0.05, 0.9, 0.05, 0.0], [0.4, 0.25, 0.25, 0.1], [0, 1, 0, 0]])
    assert multimodal.modes_holding(weights, 0.9).tolist() == [3, 1, 3, 1]
    assert multimodal.modes_holding(weights, 1.0).tolist() == [4, 3, 4, 1]
    assert multimodal.modes_holding(weights[:, :1] * 0 + 1, 0.9).tolist() == [1, 1, 1, 1]


def test_the_tolerance_itself_is_a_miss() -> None:
    only = MODES[:, 2:]
    assert multimodal.missed(only, np.ones((1, 1)), TRUTH, 1).tolist() == [1]
    assert multimodal.missed(only, np.ones((1, 1)), TRUTH, 1, tolerance_m=2.0001).tolist() == [0]


def test_of_equals_the_last_comes_first() -> None:
    assert multimodal.by_probability(np.full((1, 30), 1 / 30)).tolist() == [list(range(29, -1, -1))]


@given(st.integers(0, 10_000), st.integers(1, 30))
def test_more_modes_are_never_worse(seed: int, modes: int) -> None:
    rng = np.random.default_rng(seed)
    some, probabilities = rng.normal(size=(4, modes, 6, 2)), rng.dirichlet(np.ones(modes), size=4)
    truth = rng.normal(size=(4, 6, 2))
    for metric in (multimodal.min_ade_m, multimodal.min_fde_m, multimodal.missed):
        values: list[Floats] = [metric(some, probabilities, truth, k) for k in (1, 5, 10)]
        assert (values[1] <= values[0]).all()
        assert (values[2] <= values[1]).all()
        order = rng.permutation(modes)
        np.testing.assert_array_equal(metric(some[:, order], probabilities[:, order], truth, 5), values[1])
    best = np.linalg.norm(some - truth[:, None], axis=-1).mean(axis=-1).min(axis=1)
    np.testing.assert_allclose(multimodal.min_ade_m(some, probabilities, truth, modes), best)


def test_nan_is_never_a_hit() -> None:
    modes = MODES.copy()
    modes[0, 2, 0, 0] = np.nan
    for metric in (multimodal.min_ade_m, multimodal.min_fde_m, multimodal.missed):
        assert np.isfinite(metric(modes, PROBABILITIES, TRUTH, 1)).all()
        assert np.isnan(metric(MODES, np.array([[0.5, np.nan, 0.5]]), TRUTH, 1)).all()
        assert np.isnan(metric(MODES, PROBABILITIES, TRUTH * np.nan, 3)).all()
    assert np.isnan(multimodal.min_ade_m(modes, PROBABILITIES, TRUTH, 2)).all()
    assert np.isnan(multimodal.missed(modes, PROBABILITIES, TRUTH, 2)).all()
    with pytest.raises(ValueError, match="at least 1"):
        multimodal.missed(MODES, PROBABILITIES, TRUTH, 0)
