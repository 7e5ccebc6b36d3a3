"""All forecasts that a track got for one instant, by age: what dispersion and convergence look at."""

import numpy as np

from model.arrays import Bools, Floats, Ints


def forecasts_by_age(made_at: Ints, forecasts: Floats, instants: Ints) -> Floats:
    """Arranges the consecutive forecasts of one track by the instant they are for.

    Args:
        made_at: [F], numbers of the 2 Hz frames that forecasts were made at, strictly ascending; gaps are
            allowed.
        forecasts: [F, T, 2], m, ground frame, of one trajectory each: element [f, t − 1] is for frame
            made_at[f] + t.
        instants: [P], numbers of the frames to look at; usually all frames of the track.

    Returns:
        [P, T, 2], m: element [p, a − 1] is for instants[p] and was made a frames (a · 0.5 s) before it;
        NaN where no forecast was made then.

    Raises:
        ValueError: the frames do not ascend, or are not as many as the forecasts.
    """
    if len(made_at) != len(forecasts):
        raise ValueError(f"{len(forecasts)} forecasts need as many frames, not {len(made_at)}")
    if (np.diff(made_at) <= 0).any():
        raise ValueError("the frames that forecasts were made at must ascend, each once")
    age = np.arange(1, forecasts.shape[1] + 1)
    result = np.full((len(instants), len(age), 2), np.nan)
    if not len(made_at):
        return result
    wanted = instants[:, None] - age
    row = np.minimum(np.searchsorted(made_at, wanted), len(made_at) - 1)  # [P, T]
    made = made_at[row] == wanted
    result[made] = forecasts[row, age - 1][made]
    return result


def complete(by_age: Floats) -> Bools:
    """At which instants there is a forecast of every age: [P, T, 2] → [P]."""
    return np.asarray(np.isfinite(by_age).all(axis=(-2, -1)))
