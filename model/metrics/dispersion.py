"""Dispersion: how far apart the forecasts for one instant are (Ben-Younes et al. 2022, section 4).

The paper takes the standard deviation, over the ages, of the forecasts' distances to their barycentre; its
table fits the mean distance better (REFERENCE.md section 4). Both are here, and the root mean square, which
is the usual spread of points in a plane: rms² = mean² + std².
"""

from typing import NamedTuple

import numpy as np

from model.arrays import Bools, Floats
from model.metrics.ages import complete
from model.metrics.displacement import displacement_m


class Dispersion(NamedTuple):
    """Of the forecasts for each of P instants; NaN where the set of ages is not complete."""

    std_m: Floats
    """[P], m, population standard deviation of the distances to the barycentre: the paper's formula."""
    mean_m: Floats
    """[P], m, mean distance to the barycentre."""
    rms_m: Floats
    """[P], m, root-mean-square distance to the barycentre."""
    complete: Bools
    """[P], whether there was a forecast of every age."""


class MeanDispersion(NamedTuple):
    """D: the mean over those instants that have a forecast of every age; None without such an instant."""

    std_m: float | None
    mean_m: float | None
    rms_m: float | None
    instants: int
    """How many have."""


def dispersion(by_age: Floats) -> Dispersion:
    """Dispersion at each instant.

    Args:
        by_age: [P, T, 2], m, the forecasts of age 0.5 … T · 0.5 s made for each instant; NaN where one is
            missing (see ``ages.forecasts_by_age``).
    """
    known = complete(by_age)
    sets = np.where(known[:, None, None], by_age, np.nan)
    distance = displacement_m(sets, sets.mean(axis=1, keepdims=True))
    rms = np.sqrt(np.square(distance).mean(axis=1))
    return Dispersion(distance.std(axis=1), distance.mean(axis=1), rms, known)


def mean_dispersion(points: Dispersion) -> MeanDispersion:
    """Mean over the instants; incomplete sets are kept out."""
    count = int(points.complete.sum())
    if not count:
        return MeanDispersion(None, None, None, 0)
    std, mean, rms = (float(values[points.complete].mean()) for values in points[:3])
    return MeanDispersion(std, mean, rms, count)
