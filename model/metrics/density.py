"""How probable the truth was: negative log-likelihood, and calibration of the stated uncertainty.

The density is that of ``TrajectoryMixture``. A mode of a unicycle that drives straight is certain of its
lateral position (Trajectron++ lets no heading uncertainty grow below 0.01 rad/s), and one that stands
nearly of all: *measured* with the published Trajectron++ weights, every tenth Gaussian is singular in float32
at 0.5 s, and some are at every step. Their likelihood tells rounding from rounding, not good from bad. So
the mixture may be ``widened`` first by the error of the labels: the likelihood then is that of the labelled
position. The published network code bounds the same thing otherwise (1 − ρ² at least 1e-5, log-likelihood at
most 6), in a way that depends on the axes.
"""

from collections.abc import Sequence

import numpy as np
import torch

from model.arrays import Floats
from model.mixture import TrajectoryMixture

LABEL_NOISE_M = 0.1
"""Standard deviation of labelled positions along each axis, m, rounded up: the Kalman filter's measurement
noise fitted to the same labels is 0.08 m."""
LEVELS = (0.5, 0.9, 0.99)
"""Probabilities of the regions that calibration looks at."""
DRAWS = 199
"""Positions drawn to find a density's rank. One more than that times each level is a whole number: the
estimated share inside is unbiased then, however few they are."""

_CHUNK_ELEMENTS = 1 << 19
"""Gaussian densities computed at once: 4 MB an array."""


def widened(mixture: TrajectoryMixture, noise_m: float) -> TrajectoryMixture:
    """The mixture of positions as labelled: each Gaussian convolved with the labels' error.

    Args:
        mixture: of any device and precision.
        noise_m: the error's standard deviation along each axis, m; 0 changes nothing but the precision.

    Returns:
        float64, on the CPU.

    Raises:
        ValueError: the noise is negative.
    """
    if not noise_m >= 0:
        raise ValueError(f"noise must not be negative: {noise_m}")
    covariances = mixture.covariances.detach().cpu().double()
    return TrajectoryMixture(
        mixture.log_weights.detach().cpu().double().log_softmax(dim=-1),  # float32 sums to 1 up to 1e-7 only
        mixture.means.detach().cpu().double(),
        covariances + noise_m**2 * torch.eye(2, dtype=torch.float64),
        mixture.origin.detach().cpu().double(),
    )


def nll(mixture: TrajectoryMixture, truth: Floats, noise_m: float = 0.0) -> Floats:
    """Negative log-likelihood of the true position at each step, under the whole mixture.

    Args:
        mixture: N, T.
        truth: [N, T, 2], m, ground frame.
        noise_m: of ``widened``, m.

    Returns:
        [N, T], nats, of a density in 1/m²; NaN where the truth is not finite, and where a mode is singular
        (without noise, or where it is so wide that its covariance's rounding is more than the noise): there
        is no density then.
    """
    wide = widened(mixture, noise_m)
    steps = -wide.log_density(torch.from_numpy(_finite(truth)))
    return _numpy(steps.masked_fill(_singular(wide), torch.nan))


def joint_nll(mixture: TrajectoryMixture, truth: Floats, noise_m: float = 0.0) -> Floats:
    """Negative log-likelihood of the whole true trajectory.

    Given the mode, the steps' densities multiply: −log Σ_k w_k Π_t N_kt(y_t).

    Returns:
        [N], nats, of a density in 1/m^(2T); NaN where ``nll`` is at any step. Arguments as there.
    """
    wide = widened(mixture, noise_m)
    steps = wide.component_log_density(torch.from_numpy(_finite(truth)))
    joint = -torch.logsumexp(wide.log_weights + steps.sum(dim=-1), dim=-1)
    return _numpy(joint.masked_fill(_singular(wide).any(dim=1), torch.nan))


def density_rank(
    mixture: TrajectoryMixture,
    truth: Floats,
    seeds: Sequence[int],
    noise_m: float = 0.0,
    draws: int = DRAWS,
) -> Floats:
    """The probability of the region, at each step, in which the density is higher than at the truth.

    The truth is inside the highest-density region of probability p where this is below p; for a calibrated
    forecast it is uniform on (0, 1). With one mode the region is an ellipse: 1 − exp(−m²/2) for a
    Mahalanobis distance m. With more, positions are drawn: (those denser than the truth + ½) / (draws + 1).

    Args:
        mixture: N, T.
        truth: [N, T, 2], m, ground frame.
        seeds: N, one an instance (see ``TrajectoryMixture.sample``); unused with one mode.
        noise_m: of ``widened``, m.
        draws: positions drawn at each step.

    Returns:
        [N, T]; NaN where the truth is not finite or a mode is singular, as in ``nll``.
    """
    wide, target = widened(mixture, noise_m), torch.from_numpy(_finite(truth))
    at_truth = wide.log_density(target).masked_fill(_singular(wide), torch.nan)
    if wide.log_weights.shape[1] == 1:
        return _numpy(-torch.expm1(at_truth - wide.log_density(wide.world_means[:, 0])))
    denser = torch.zeros_like(at_truth)
    chunk = max(1, _CHUNK_ELEMENTS // (draws * wide.means[0, :, :, 0].numel()))
    for start in range(0, len(wide), chunk):
        part = wide[start : start + chunk]
        density = part.log_densities(part.sample(draws, seeds[start : start + chunk]))
        denser[start : start + chunk] = (density > at_truth[start : start + chunk, None]).sum(dim=1)
    rank = (denser + 0.5) / (draws + 1)
    return _numpy(torch.where(at_truth.isnan(), torch.nan, rank))


def inside_region(rank: Floats, level: float) -> Floats:
    """Whether the truth was inside the highest-density region; the mean over instances is to equal the level.

    Args:
        rank: [...], of ``density_rank``.
        level: the region's probability.

    Returns:
        [...], 1 or 0; NaN where the rank is.
    """
    return np.where(np.isnan(rank), np.nan, rank < level)


def _singular(mixture: TrajectoryMixture) -> torch.Tensor:
    """Where a mode's covariance has no inverse: [N, T]."""
    c = mixture.covariances
    return (c[..., 0, 0] * c[..., 1, 1] <= c[..., 0, 1].square()).any(dim=1)


def _finite(truth: Floats) -> Floats:
    """Infinities become NaN, and a view becomes an array that torch takes."""
    return np.ascontiguousarray(np.where(np.isfinite(truth), truth, np.nan))


def _numpy(values: torch.Tensor) -> Floats:
    return values.numpy().astype(np.float64, copy=False)
