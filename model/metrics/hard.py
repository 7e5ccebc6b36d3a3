"""Hard cases: the instances that a Kalman filter mistakes most (Ben-Younes et al. 2022, section 4)."""

import numpy as np

from model.arrays import Bools, Floats

HARD_SHARES = (0.01, 0.02, 0.03)
"""Those of the paper's table."""


def hardest(mismatch_m: Floats, share: float) -> Bools:
    """Marks the share of instances with the greatest mismatch.

    So many as the share is of N, rounded, and at least one; of equals the first. A smaller share's instances
    are among a greater one's.

    Args:
        mismatch_m: [N], m: how far the Kalman filter's forecast is from the truth at 6 s
            (``displacement.fde_m``).
        share: in (0, 1].

    Returns:
        [N].

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
