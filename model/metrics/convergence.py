"""Convergence-to-range: since when forecasts for an instant have been right (Ben-Younes et al. 2022,
section 4).

C(τ) is the largest t such that all forecasts of age 1 … t lie within τ of the truth, 0 if the newest does
not. The paper defines it in steps and tabulates seconds.
"""

import numpy as np

from model.arrays import Floats
from model.metrics.displacement import displacement_m
from model.scenes.scene import STEP_SECONDS

RANGES_M = (0.2, 1.0, 5.0)
"""τ of the paper's table."""


def errors_by_age_m(by_age: Floats, truth: Floats) -> Floats:
    """Displacement error of each forecast made for an instant, newest first.

    Args:
        by_age: [P, T, 2], m (see ``ages.forecasts_by_age``).
        truth: [P, 2], m, where the agent was.

    Returns:
        [P, T], m; NaN where a forecast is missing or the truth is not finite.
    """
    return displacement_m(by_age, truth[:, None])


def convergence_steps(errors_m: Floats, range_m: float) -> Floats:
    """C(τ) in steps.

    Args:
        errors_m: [P, T], of ``errors_by_age_m``.
        range_m: τ, m; an error equal to it is within.

    Returns:
        [P], 0 … T. NaN where any age is missing, also where C could be told all the same: those are the
        instants at which it is short, and keeping them alone would bias the mean.
    """
    within = np.logical_and.accumulate(errors_m <= range_m, axis=1)
    return np.where(np.isnan(errors_m).any(axis=1), np.nan, within.sum(axis=1))


def convergence_s(errors_m: Floats, range_m: float) -> Floats:
    """C(τ) in seconds: [P], 0 … T · 0.5 s. Arguments and NaN as for ``convergence_steps``."""
    return convergence_steps(errors_m, range_m) * STEP_SECONDS
