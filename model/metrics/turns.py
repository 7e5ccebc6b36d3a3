"""Turns that begin after now: the history does not tell them, so that a forecast needs the context."""

from typing import Final

import numpy as np

from model.arrays import Bools, Floats
from model.geometry import wrap_angle

STRAIGHT: Final = np.deg2rad(5.0)
"""rad; an agent whose heading was always nearer to its present one has not begun to turn."""
TURNED: Final = np.deg2rad(30.0)
"""rad; a change of heading that is a turn."""


def turns_after_now(past: Floats, future: Floats) -> Bools:
    """Return whether agents went straight until now and turn afterwards.

    Args:
        past: [N, F], rad, headings up to now, the last one now; NaN where not seen, but not now.
        future: [N, T], rad, headings after now; NaN where not seen.

    Returns:
        [N]: no past heading differs from the present one by 5° or more, and a future one does by 30° or more.
    """
    now = past[:, -1:]
    straight = ~(np.abs(wrap_angle(past - now)) >= STRAIGHT).any(axis=1)
    steps = np.nan_to_num(wrap_angle(np.diff(future, axis=1, prepend=now)))
    return np.asarray(straight & (np.abs(np.cumsum(steps, axis=1)) >= TURNED).any(axis=1))
