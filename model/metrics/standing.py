"""Who stood before now: as the challenge picks agents that move, these are unlike others that stand."""

from typing import Final

import numpy as np

from model.arrays import Bools, Floats

STANDING_FRAMES: Final = 4
"""Frames of 0.5 s before now that are looked at: 2 s."""
STANDING_M: Final = 0.3
"""m; who was never so far from where it is now stood. Of the pairs of nuScenes' train_val there are 354."""


def stood(positions: Floats) -> Bools:
    """Return whether an agent stood for 2 s: it was seen at each frame, never 0.3 m from where it is now.

    Args:
        positions: [..., F, 2], m, in any frame of reference, at 2 Hz, the last one now; NaN where it was not
            seen. Of more than five frames the last five count.

    Returns:
        [...]; false where there are fewer than five frames.
    """
    newest = positions[..., -STANDING_FRAMES - 1 :, :]
    if newest.shape[-2] <= STANDING_FRAMES:
        return np.zeros(positions.shape[:-2], dtype=np.bool_)
    offset = newest - newest[..., -1:, :]
    return np.asarray((np.hypot(offset[..., 0], offset[..., 1]) < STANDING_M).all(axis=-1))
