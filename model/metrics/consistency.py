"""Consistency of a track's forecasts over time: dispersion and convergence-to-range (Ben-Younes et al. 2022).

Both compare the forecasts made for one instant at different ages (section 4 of the paper).

- Dispersion is their spread. The paper defines it as the standard deviation, over the ages, of the forecasts'
  distances to their barycentre; its table fits the mean distance better (REFERENCE.md section 4). Both are
  here, and the root mean square, which is the usual spread of points in a plane: rms² = mean² + std².
- Convergence-to-range is how long they have been right: C(τ) is the largest t such that all forecasts of age
  1 … t lie within τ of the truth, 0 if the newest does not. The paper defines it in steps and tabulates
  seconds.
"""

from typing import NamedTuple

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.metrics.displacement import displacement_m
from model.scenes.scene import STEP_SECONDS

RANGES_M = (0.2, 1.0, 5.0)
"""τ of the paper's table, m."""


class Dispersion(NamedTuple):
    """Dispersion of the forecasts for each of P instants; NaN where the set of ages is not complete."""

    std_m: Floats
    """[P], m, population standard deviation of the distances to the barycentre: the paper's formula."""
    mean_m: Floats
    """[P], m, mean distance to the barycentre."""
    rms_m: Floats
    """[P], m, root-mean-square distance to the barycentre."""
    complete: Bools
    """[P], whether there was a forecast of every age."""


def forecasts_by_age(made_at: Ints, forecasts: Floats, instants: Ints) -> Floats:
    """Arrange the consecutive forecasts of one track by the instant they are for.

    Args:
        made_at: [F], numbers of the 2 Hz frames at which forecasts were made, strictly ascending; gaps are
            allowed.
        forecasts: [F, T, 2], m, ground frame, of one trajectory each: element [f, t − 1] is for frame
            made_at[f] + t.
        instants: [P], numbers of the frames that forecasts are for; usually all frames of the track.

    Returns:
        [P, T, 2], m: element [p, a − 1] is for instants[p] and was made a frames (a · 0.5 s) before it;
        NaN where no forecast was made then.

    Raises:
        ValueError: the frames do not ascend, or their number is not that of the forecasts.
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
    """Return at which instants there is a forecast of every age: [P, T, 2] → [P]."""
    return np.asarray(np.isfinite(by_age).all(axis=(-2, -1)))


def dispersion(by_age: Floats) -> Dispersion:
    """Return the dispersion at each instant.

    Args:
        by_age: [P, T, 2], m, the forecasts of age 0.5 … T · 0.5 s made for each instant; NaN where one is
            missing (see ``forecasts_by_age``).
    """
    known = complete(by_age)
    sets = np.where(known[:, None, None], by_age, np.nan)
    distance = displacement_m(sets, sets.mean(axis=1, keepdims=True))
    rms = np.sqrt(np.square(distance).mean(axis=1))
    return Dispersion(distance.std(axis=1), distance.mean(axis=1), rms, known)


def errors_by_age_m(by_age: Floats, truth: Floats) -> Floats:
    """Return the displacement error of each forecast made for an instant, newest first.

    Args:
        by_age: [P, T, 2], m (see ``forecasts_by_age``).
        truth: [P, 2], m, true positions.

    Returns:
        [P, T], m; NaN where a forecast is missing or the truth is not finite.
    """
    return displacement_m(by_age, truth[:, None])


def convergence_steps(errors_m: Floats, range_m: float) -> Floats:
    """Return C(τ) in steps.

    Args:
        errors_m: [P, T], from ``errors_by_age_m``.
        range_m: τ, m; an error equal to it is within.

    Returns:
        [P], 0 … T. NaN where any age is missing, even where C is known nevertheless: at those instants C is
        short, so that keeping only them would bias the mean.
    """
    within = np.logical_and.accumulate(errors_m <= range_m, axis=1)
    return np.where(np.isnan(errors_m).any(axis=1), np.nan, within.sum(axis=1))


def convergence_s(errors_m: Floats, range_m: float) -> Floats:
    """Return C(τ) in seconds: [P], 0 … T · 0.5 s. Arguments and NaN as in ``convergence_steps``."""
    return convergence_steps(errors_m, range_m) * STEP_SECONDS
