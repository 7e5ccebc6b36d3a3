"""Distance between forecast and truth: ADE and FDE by horizon, of one trajectory or expected over many.

ADE: mean distance over the steps up to a horizon; FDE: distance at it (Ben-Younes et al. 2022, section 4;
nuscenes-devkit ``mean_distances``, ``final_distances``).
"""

import numpy as np

from model.arrays import Floats
from model.scenes.scene import STEP_SECONDS

HORIZONS_S = (1, 2, 3, 4, 5, 6)
"""Those of the paper's tables."""


def displacement_m(forecast: Floats, truth: Floats) -> Floats:
    """Euclidean distance at each step.

    Args:
        forecast: [..., T, 2], m.
        truth: broadcastable to it, m.

    Returns:
        [..., T], m; NaN where either is not finite.
    """
    with np.errstate(invalid="ignore"):  # infinity less infinity
        offset = forecast - truth
    distance: Floats = np.hypot(offset[..., 0], offset[..., 1])
    return np.where(np.isfinite(distance), distance, np.nan)


def horizon_steps(horizon_s: float) -> int:
    """How many steps of a forecast a horizon takes.

    Raises:
        ValueError: it is no positive multiple of the step, 0.5 s.
    """
    steps = horizon_s / STEP_SECONDS
    if not (steps >= 1 and steps == int(steps)):
        raise ValueError(f"a horizon must be a positive multiple of {STEP_SECONDS} s, not {horizon_s}")
    return int(steps)


def horizons_within(steps: int) -> tuple[int, ...]:
    """Those of ``HORIZONS_S`` that a forecast of so many steps reaches, s."""
    return tuple(h for h in HORIZONS_S if horizon_steps(h) <= steps)


def ade_m(errors_m: Floats, horizon_s: float) -> Floats:
    """Mean distance over the steps up to a horizon.

    Args:
        errors_m: [..., T], of ``displacement_m``.
        horizon_s: s.

    Returns:
        [...], m; NaN where one of the steps is.

    Raises:
        ValueError: the horizon is longer than the forecast, or no multiple of the step.
    """
    return np.asarray(errors_m[..., : _steps_within(errors_m, horizon_s)].mean(axis=-1))


def fde_m(errors_m: Floats, horizon_s: float) -> Floats:
    """Distance at a horizon: [...], m. Arguments and errors as for ``ade_m``; NaN where that step is."""
    return np.asarray(errors_m[..., _steps_within(errors_m, horizon_s) - 1])


def expected_displacement_m(samples: Floats, truth: Floats) -> Floats:
    """Distance at each step, averaged over trajectories drawn from the whole forecast (the paper: 2000).

    ``ade_m`` and ``fde_m`` of it are ADE-f and FDE-f: the mean over samples and that over steps commute.

    Args:
        samples: [N, S, T, 2], m.
        truth: [N, T, 2], m.

    Returns:
        [N, T], m; NaN where the truth or a sample is not finite.
    """
    return np.asarray(displacement_m(samples, truth[:, None]).mean(axis=1))


def expected_ade_m(samples: Floats, truth: Floats, horizon_s: float) -> Floats:
    """ADE-f up to a horizon: [N], m; NaN where one of the steps is. Arguments as above."""
    return ade_m(expected_displacement_m(samples, truth), horizon_s)


def expected_fde_m(samples: Floats, truth: Floats, horizon_s: float) -> Floats:
    """FDE-f at a horizon: [N], m; NaN where that step is. Arguments as above."""
    return fde_m(expected_displacement_m(samples, truth), horizon_s)


def _steps_within(errors_m: Floats, horizon_s: float) -> int:
    steps = horizon_steps(horizon_s)
    if steps > errors_m.shape[-1]:
        raise ValueError(f"a forecast of {errors_m.shape[-1]} steps does not reach {horizon_s} s")
    return steps
