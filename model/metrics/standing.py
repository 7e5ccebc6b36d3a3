"""Agents that stood before now; as the challenge selects moving agents, they are unlike other ones."""

from typing import Final

import numpy as np

from model.arrays import Bools, Floats

STANDING_FRAMES: Final = 4
"""Number of frames of 0.5 s before now that count: 2 s."""
STANDING_M: Final = 0.3
"""m; an agent that was always nearer to its present position stood. There are 354 in nuScenes' train_val."""


def stood(positions: Floats) -> Bools:
    """Return whether agents stood for 2 s: seen at each frame, always within 0.3 m of the present position.

    Args:
        positions: [..., F, 2], m, in any frame of reference, at 2 Hz, the last one now; NaN where not seen.
            Of more than five frames the last five count.

    Returns:
        [...]; false where there are fewer than five frames.
    """
    newest = positions[..., -STANDING_FRAMES - 1 :, :]
    if newest.shape[-2] <= STANDING_FRAMES:
        return np.zeros(positions.shape[:-2], dtype=np.bool_)
    offset = newest - newest[..., -1:, :]
    return np.asarray((np.hypot(offset[..., 0], offset[..., 1]) < STANDING_M).all(axis=-1))
