"""The best of the k most probable modes, as nuscenes-devkit has it (``eval/prediction/metrics.py``)."""

import numpy as np

from model.arrays import Floats, Ints
from model.metrics.displacement import displacement_m

TOP_K = (1, 5, 10)
"""What nuScenes' challenge reports."""
MISS_TOLERANCE_M = 2.0
"""A mode misses that is anywhere this far from the truth, or farther."""


def by_probability(probabilities: Floats) -> Ints:
    """The modes' indices, most probable first: [N, K] → [N, K].

    Of equal ones the last comes first. So it is in the devkit for up to 16 modes, where the sort that it
    calls is stable; with more it leaves ties to numpy's version and the processor, and this does not.
    """
    return np.flip(np.argsort(probabilities, axis=-1, kind="stable"), axis=-1).astype(np.int64)


def best_of_top_k(values: Floats, probabilities: Floats, k: int) -> Floats:
    """The least value among the k most probable modes (devkit ``rank_metric_over_top_k_modes``, "min").

    Args:
        values: [N, K], any unit.
        probabilities: [N, K]; their scale does not matter.
        k: at least 1; with fewer modes, all of them count.

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
    """minADE_k: the least mean distance (devkit ``MinADEK``).

    Args:
        modes: [N, K, T, 2], m.
        probabilities: [N, K].
        truth: [N, T, 2], m.
        k: how many modes count.

    Returns:
        [N], m; NaN as in ``best_of_top_k``.
    """
    return best_of_top_k(_errors_m(modes, truth).mean(axis=-1), probabilities, k)


def min_fde_m(modes: Floats, probabilities: Floats, truth: Floats, k: int) -> Floats:
    """minFDE_k: the least distance at the last step (devkit ``MinFDEK``): [N], m. As ``min_ade_m``."""
    return best_of_top_k(_errors_m(modes, truth)[..., -1], probabilities, k)


def missed(
    modes: Floats, probabilities: Floats, truth: Floats, k: int, tolerance_m: float = MISS_TOLERANCE_M
) -> Floats:
    """Whether every one of the k modes misses (devkit ``MissRateTopK``); the mean is the miss rate.

    A mode misses whose greatest distance from the truth is the tolerance or more.

    Returns:
        [N], 1 or 0; NaN as in ``min_ade_m``. Arguments as there.
    """
    farthest = _errors_m(modes, truth).max(axis=-1)
    misses = np.where(np.isnan(farthest), np.nan, farthest >= tolerance_m)
    return best_of_top_k(misses, probabilities, k)


def brier_min_fde_m(modes: Floats, probabilities: Floats, truth: Floats, k: int) -> Floats:
    """brier-minFDE_k: minFDE_k and (1 − p)², p the probability of the mode that is nearest at the last step.

    As Argoverse has it: it asks of the mode that comes true that it was held probable. Of modes equally near
    the most probable counts.

    Returns:
        [N], m and a number from 0 to 1 added; NaN as in ``min_ade_m``. Arguments as there; probabilities sum
        to 1 over all K modes, not over the k.
    """
    errors_m = _errors_m(modes, truth)[..., -1]
    ranked = by_probability(probabilities)[:, :k]
    nearest = np.take_along_axis(errors_m, ranked, axis=1).argmin(axis=1)[:, None]
    chosen = np.take_along_axis(probabilities, np.take_along_axis(ranked, nearest, axis=1), axis=1)[:, 0]
    return best_of_top_k(errors_m, probabilities, k) + (1 - chosen) ** 2


def modes_holding(probabilities: Floats, share: float) -> Floats:
    """Return how many modes, the most probable first, together hold a share of the probability: [N].

    Args:
        probabilities: [N, K], summing to 1; zero for modes that are padding.
        share: in (0, 1].
    """
    held = np.cumsum(-np.sort(-probabilities, axis=1), axis=1)
    short = held < share - 1e-6  # float32's weights sum to 1 up to that
    return np.asarray(1.0 + short[:, :-1].sum(axis=1))


def _errors_m(modes: Floats, truth: Floats) -> Floats:
    """[N, K, T], m."""
    return displacement_m(modes, truth[:, None])
