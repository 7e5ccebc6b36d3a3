"""Hard cases: instances with the largest errors of a Kalman filter (Ben-Younes et al. 2022, section 4)."""

import numpy as np

from model.arrays import Bools, Floats

HARD_SHARES = (0.01, 0.02, 0.03)
"""Shares of the paper's table."""


def hardest(mismatch_m: Floats, share: float) -> Bools:
    """Mark the share of instances with the largest mismatch.

    Their number is the share of N, rounded, at least one; ties go to the first. The instances of a smaller
    share are among those of a larger one.

    Args:
        mismatch_m: [N], m, distance of the Kalman filter's forecast from the truth at 6 s
            (``displacement.fde_m``).
        share: in (0, 1].

    Returns:
        [N], whether an instance is among them.

    Raises:
        ValueError: the share is outside its bounds, or a mismatch is not finite and so has no rank.
    """
    if not 0 < share <= 1:
        raise ValueError(f"a share must be in (0, 1], not {share}")
    if not np.isfinite(mismatch_m).all():
        raise ValueError("every instance needs a finite mismatch to be ranked by")
    marked = np.zeros(len(mismatch_m), dtype=np.bool_)
    count = max(1, round(share * len(mismatch_m)))
    marked[np.argsort(-mismatch_m, kind="stable")[:count]] = True
    return marked


def hardest_of_known(mismatch_m: Floats, share: float) -> Bools:
    """Mark the hardest among the instances whose mismatch is finite, as ``hardest`` does.

    Args:
        mismatch_m: [N], m; others than finite ones are not marked and do not count.
        share: in (0, 1], of the instances with a finite mismatch.

    Returns:
        [N], whether an instance is among them.

    Raises:
        ValueError: the share is outside its bounds.
    """
    marked = np.isfinite(mismatch_m)
    marked[marked] = hardest(mismatch_m[marked], share)
    return marked
