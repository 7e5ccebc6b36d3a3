import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from model.arrays import Floats
from model.metrics.hard import HARD_SHARES, hardest, hardest_of_known


def test_by_hand() -> None:
    mismatch = np.arange(200.0)
    for share, count in zip(HARD_SHARES, (2, 4, 6), strict=True):
        assert hardest(mismatch, share).nonzero()[0].tolist() == list(range(200 - count, 200))
    assert hardest(np.zeros(100), 0.03).nonzero()[0].tolist() == [0, 1, 2]
    assert [int(hardest(np.arange(8560.0), s).sum()) for s in HARD_SHARES] == [86, 171, 257]
    assert hardest(np.array([1.0, 2.0]), 0.01).tolist() == [False, True]
    assert hardest(np.array([]), 0.01).tolist() == []


@given(arrays(np.float64, st.integers(1, 300), elements=st.floats(0, 100)))
def test_the_hardest_are_harder_than_the_rest(mismatch: Floats) -> None:
    marks = [hardest(mismatch, share) for share in HARD_SHARES]
    for mark in marks:
        assert mark.all() or mismatch[mark].min() >= mismatch[~mark].max()
    assert (marks[0] <= marks[1]).all()
    assert (marks[1] <= marks[2]).all()


def test_what_cannot_be_ranked() -> None:
    with pytest.raises(ValueError, match="finite"):
        hardest(np.array([1.0, np.nan]), 0.5)
    for share in (0, -1, 1.5, float("nan")):
        with pytest.raises(ValueError, match="share"):
            hardest(np.ones(3), share)


def test_instances_without_a_mismatch_have_no_rank() -> None:
    mismatch_m = np.array([np.nan, 3.0, np.inf, 9.0, 1.0, 2.0])
    assert hardest_of_known(mismatch_m, 0.5).tolist() == [False, True, False, True, False, False]
    assert not hardest_of_known(np.full(3, np.nan), 0.5).any()
