"""Probability of the truth: negative log-likelihood, and calibration of the stated uncertainty.

The density is that of ``TrajectoryMixture``. A mode of a unicycle that drives straight is certain of its
lateral position (in Trajectron++ no heading uncertainty grows below 0.01 rad/s), and one that stands is
nearly certain of all: *measured* with the published Trajectron++ weights, every tenth Gaussian is singular
in float32 at 0.5 s, and some are at every step. Their likelihoods differ by rounding, not by quality. So the
mixture may first be ``widened`` by the error of the labels; the likelihood is then that of the labelled
position. The published network code has other bounds for the same purpose (1 − ρ² at least 1e-5,
log-likelihood at most 6), which depend on the axes.
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
"""Probabilities of the regions for calibration."""
DRAWS = 199
"""Positions drawn to estimate a density's rank. (DRAWS + 1) times each level is a whole number, which makes
the estimated share inside unbiased, however few draws there are."""

_CHUNK_ELEMENTS = 1 << 19
"""Gaussian densities computed at once; 4 MB an array."""


def widened(mixture: TrajectoryMixture, noise_m: float) -> TrajectoryMixture:
    """Return the mixture of labelled positions: each Gaussian convolved with the labels' error.

    Args:
        mixture: forecasts on any device, of any precision.
        noise_m: the error's standard deviation along each axis, m; 0 changes only the precision.

    Returns:
        The mixture in float64, on the CPU.

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
    """Return the negative log-likelihood of the true position at each step, under the whole mixture.

    Args:
        mixture: N forecasts of T steps.
        truth: [N, T, 2], m, ground frame.
        noise_m: noise of ``widened``, m.

    Returns:
        [N, T], nats, of a density in 1/m²; NaN where the truth is not finite, and where a mode is singular,
        so that there is no density (without noise, or where the rounding of a wide covariance exceeds the
        noise).
    """
    wide = widened(mixture, noise_m)
    steps = -wide.log_density(torch.from_numpy(_finite(truth)))
    return _numpy(steps.masked_fill(_singular(wide), torch.nan))


def joint_nll(mixture: TrajectoryMixture, truth: Floats, noise_m: float = 0.0) -> Floats:
    """Return the negative log-likelihood of the whole true trajectory.

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
    """Return the probability of the region in which the density is higher than at the truth, at each step.

    The truth is inside the highest-density region of probability p where this is below p. For a calibrated
    forecast it is uniform on (0, 1). With one mode the region is an ellipse: 1 − exp(−m²/2) for a
    Mahalanobis distance m. With more, positions are drawn: (those denser than the truth + ½) / (draws + 1).

    Args:
        mixture: N forecasts of T steps.
        truth: [N, T, 2], m, ground frame.
        seeds: N seeds, one per instance (see ``TrajectoryMixture.sample``); unused with one mode.
        noise_m: noise of ``widened``, m.
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
    """Return whether the truth was inside the highest-density region of a probability.

    The mean over instances equals that probability if the forecasts are calibrated.

    Args:
        rank: [...], from ``density_rank``.
        level: probability of the region.

    Returns:
        [...], 1 or 0; NaN where the rank is.
    """
    return np.where(np.isnan(rank), np.nan, rank < level)


def _singular(mixture: TrajectoryMixture) -> torch.Tensor:
    """Return where a mode's covariance has no inverse: [N, T]."""
    c = mixture.covariances
    return (c[..., 0, 0] * c[..., 1, 1] <= c[..., 0, 1].square()).any(dim=1)


def _finite(truth: Floats) -> Floats:
    """Return the truth with infinities as NaN, as a contiguous array, which torch needs."""
    return np.ascontiguousarray(np.where(np.isfinite(truth), truth, np.nan))


def _numpy(values: torch.Tensor) -> Floats:
    return values.numpy().astype(np.float64, copy=False)
