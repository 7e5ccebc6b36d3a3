"""Metrics of the k most probable modes, as in nuscenes-devkit (``eval/prediction/metrics.py``)."""

import numpy as np

from model.arrays import Floats, Ints
from model.metrics.displacement import displacement_m

TOP_K = (1, 5, 10)
"""k of nuScenes' challenge."""
MISS_TOLERANCE_M = 2.0
"""A mode misses if it is this far from the truth, or farther, at any step."""


def by_probability(probabilities: Floats) -> Ints:
    """Return the modes' indices, most probable first: [N, K] → [N, K].

    Among ties the last comes first. This equals the devkit for up to 16 modes, for which its sort is stable;
    with more, the devkit's order of ties depends on numpy's version and the processor.
    """
    return np.flip(np.argsort(probabilities, axis=-1, kind="stable"), axis=-1).astype(np.int64)


def best_of_top_k(values: Floats, probabilities: Floats, k: int) -> Floats:
    """Return the minimum over the k most probable modes (devkit ``rank_metric_over_top_k_modes``, "min").

    Args:
        values: [N, K], any unit.
        probabilities: [N, K]; their scale does not matter.
        k: number of modes, at least 1; with fewer modes, all of them count.

    Returns:
        [N]; NaN where one of those k values is NaN, or one of the K probabilities is not finite.

    Raises:
        ValueError: k is less than 1.
    """
    if k < 1:
        raise ValueError(f"k must be at least 1, not {k}")
    ranked = np.take_along_axis(values, by_probability(probabilities)[:, :k], axis=1)
    return np.where(np.isfinite(probabilities).all(axis=1), ranked.min(axis=1), np.nan)


def min_ade_m(modes: Floats, probabilities: Floats, truth: Floats, k: int) -> Floats:
    """Return minADE_k, the minimum of the mean distance (devkit ``MinADEK``).

    Args:
        modes: [N, K, T, 2], m.
        probabilities: [N, K].
        truth: [N, T, 2], m.
        k: number of modes that count.

    Returns:
        [N], m; NaN as in ``best_of_top_k``.
    """
    return best_of_top_k(_errors_m(modes, truth).mean(axis=-1), probabilities, k)


def min_fde_m(modes: Floats, probabilities: Floats, truth: Floats, k: int) -> Floats:
    """Return minFDE_k, the minimum final distance (devkit ``MinFDEK``): [N], m, as ``min_ade_m``."""
    return best_of_top_k(_errors_m(modes, truth)[..., -1], probabilities, k)


def missed(
    modes: Floats, probabilities: Floats, truth: Floats, k: int, tolerance_m: float = MISS_TOLERANCE_M
) -> Floats:
    """Return whether all of the k modes miss (devkit ``MissRateTopK``); the mean is the miss rate.

    A mode misses if its maximum distance from the truth is the tolerance or more.

    Returns:
        [N], 1 or 0; NaN as in ``min_ade_m``. Arguments as there.
    """
    farthest = _errors_m(modes, truth).max(axis=-1)
    misses = np.where(np.isnan(farthest), np.nan, farthest >= tolerance_m)
    return best_of_top_k(misses, probabilities, k)


def brier_min_fde_m(modes: Floats, probabilities: Floats, truth: Floats, k: int) -> Floats:
    """Return brier-minFDE_k: minFDE_k + (1 − p)², p the probability of the mode nearest at the last step.

    The definition is Argoverse's; it rewards a high probability of the mode that comes true. Among equally
    near modes the most probable counts.

    Returns:
        [N], m, plus a number from 0 to 1; NaN as in ``min_ade_m``. Arguments as there; probabilities sum
        to 1 over all K modes, not over the k.
    """
    errors_m = _errors_m(modes, truth)[..., -1]
    ranked = by_probability(probabilities)[:, :k]
    nearest = np.take_along_axis(errors_m, ranked, axis=1).argmin(axis=1)[:, None]
    chosen = np.take_along_axis(probabilities, np.take_along_axis(ranked, nearest, axis=1), axis=1)[:, 0]
    return best_of_top_k(errors_m, probabilities, k) + (1 - chosen) ** 2


def modes_holding(probabilities: Floats, share: float) -> Floats:
    """Return the number of most probable modes that together hold a share of the probability: [N].

    Args:
        probabilities: [N, K], summing to 1; zero for modes that are padding.
        share: in (0, 1].
    """
    held = np.cumsum(-np.sort(-probabilities, axis=1), axis=1)
    short = held < share - 1e-6  # float32's weights sum to 1 up to that
    return np.asarray(1.0 + short[:, :-1].sum(axis=1))


def _errors_m(modes: Floats, truth: Floats) -> Floats:
    """Return distances [N, K, T], m."""
    return displacement_m(modes, truth[:, None])
