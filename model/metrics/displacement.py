"""Distances between forecast and truth: ADE and FDE by horizon, for one trajectory or expected over many.

ADE: mean distance over the steps up to a horizon; FDE: distance at it (Ben-Younes et al. 2022, section 4;
nuscenes-devkit ``mean_distances``, ``final_distances``).
"""

import numpy as np

from model.arrays import Floats
from model.scenes.scene import STEP_SECONDS

HORIZONS_S = (1, 2, 3, 4, 5, 6)
"""Horizons of the paper's tables, s."""


def displacement_m(forecast: Floats, truth: Floats) -> Floats:
    """Return the Euclidean distance at each step.

    Args:
        forecast: [..., T, 2], m.
        truth: broadcastable to it, m.

    Returns:
        [..., T], m; NaN where either is not finite.
    """
    with np.errstate(invalid="ignore"):  # infinity minus infinity
        offset = forecast - truth
    distance: Floats = np.hypot(offset[..., 0], offset[..., 1])
    return np.where(np.isfinite(distance), distance, np.nan)


def horizon_steps(horizon_s: float) -> int:
    """Return the number of steps up to a horizon.

    Raises:
        ValueError: the horizon is no positive multiple of the step, 0.5 s.
    """
    steps = horizon_s / STEP_SECONDS
    if not (steps >= 1 and steps == int(steps)):
        raise ValueError(f"a horizon must be a positive multiple of {STEP_SECONDS} s, not {horizon_s}")
    return int(steps)


def horizons_within(steps: int) -> tuple[int, ...]:
    """Return those of ``HORIZONS_S`` that a forecast of so many steps reaches, s."""
    return tuple(h for h in HORIZONS_S if horizon_steps(h) <= steps)


def ade_m(errors_m: Floats, horizon_s: float) -> Floats:
    """Return the mean distance over the steps up to a horizon.

    Args:
        errors_m: [..., T], from ``displacement_m``.
        horizon_s: s.

    Returns:
        [...], m; NaN where one of the steps is.

    Raises:
        ValueError: the horizon is longer than the forecast, or no multiple of the step.
    """
    return np.asarray(errors_m[..., : _steps_within(errors_m, horizon_s)].mean(axis=-1))


def fde_m(errors_m: Floats, horizon_s: float) -> Floats:
    """Return the distance at a horizon: [...], m; NaN where that step is. Otherwise as ``ade_m``."""
    return np.asarray(errors_m[..., _steps_within(errors_m, horizon_s) - 1])


def expected_displacement_m(samples: Floats, truth: Floats) -> Floats:
    """Return the distance at each step, averaged over trajectories drawn from the forecast (the paper: 2000).

    ``ade_m`` and ``fde_m`` of it are ADE-f and FDE-f: the mean over samples and that over steps commute.

    Args:
        samples: [N, S, T, 2], m.
        truth: [N, T, 2], m.

    Returns:
        [N, T], m; NaN where the truth or a sample is not finite.
    """
    return np.asarray(displacement_m(samples, truth[:, None]).mean(axis=1))


def _steps_within(errors_m: Floats, horizon_s: float) -> int:
    steps = horizon_steps(horizon_s)
    if steps > errors_m.shape[-1]:
        raise ValueError(f"a forecast of {errors_m.shape[-1]} steps does not reach {horizon_s} s")
    return steps
