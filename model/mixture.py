"""Gaussian mixtures over future positions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class TrajectoryMixture:
    """For each of N agents, K modes: a probability, and a 2-D Gaussian at each of T steps.

    Positions are relative to ``origin``, which alone is float64: far from the ground frame's origin
    float32 would lose centimetres. A mode's weight holds for the whole trajectory; given the mode, the
    steps' densities multiply (Trajectron++, Salzmann et al. 2020, section 4).
    """

    log_weights: Tensor
    """[N, K], normalised."""
    means: Tensor
    """[N, K, T, 2], m, relative to origin."""
    covariances: Tensor
    """[N, K, T, 2, 2], m²."""
    origin: Tensor
    """[N, 2] float64, m, ground frame."""

    @property
    def weights(self) -> Tensor:
        """[N, K], summing to 1."""
        return self.log_weights.exp()

    @property
    def world_means(self) -> Tensor:
        """[N, K, T, 2] float64, m, ground frame."""
        return self.means.double() + self.origin[:, None, None, :]

    def __len__(self) -> int:
        return len(self.log_weights)

    def __getitem__(self, index: slice | Tensor) -> "TrajectoryMixture":
        """Some of the agents."""
        return TrajectoryMixture(
            self.log_weights[index], self.means[index], self.covariances[index], self.origin[index]
        )

    def most_likely(self) -> Tensor:
        """[N], the mode of greatest weight (the first of equals)."""
        return self.log_weights.argmax(dim=-1)

    def most_likely_trajectory(self) -> Tensor:
        """[N, T, 2] float64, the means of that mode, m, ground frame."""
        modes = self.most_likely()
        return self.world_means[torch.arange(len(self)), modes]

    def component_log_density(self, positions: Tensor) -> Tensor:
        """Log-density of each mode at each step, without the weights: [N, K, T].

        Args:
            positions: [N, T, 2] float64, m, ground frame.
        """
        relative = (positions - self.origin[:, None, :]).to(self.means.dtype)
        offset = relative[:, None] - self.means
        return guarded_log_density(offset, self.covariances)

    def log_density(self, positions: Tensor) -> Tensor:
        """Log-density of the position at each step under the whole mixture: [N, T], 1/m² inside the log.

        Args:
            positions: [N, T, 2] float64, m, ground frame.
        """
        return self.log_densities(positions[:, None])[:, 0]

    def log_densities(self, positions: Tensor) -> Tensor:
        """``log_density`` of S trajectories an agent: [N, S, T].

        Args:
            positions: [N, S, T, 2] float64, m, ground frame.
        """
        relative = (positions - self.origin[:, None, None, :]).to(self.means.dtype)
        offset = relative[:, :, None] - self.means[:, None]
        # Of the covariances nothing is computed S times over
        joint = self.log_weights[:, None, :, None] + guarded_log_density(offset, self.covariances[:, None])
        return torch.logsumexp(joint, dim=2)

    def moments(self) -> tuple[Tensor, Tensor]:
        """Mean [N, T, 2] (float64, ground frame) and covariance [N, T, 2, 2] of the whole mixture."""
        weights = self.weights[:, :, None, None]
        mean = (weights * self.means).sum(1)
        offset = self.means - mean[:, None]
        outer = offset[..., :, None] * offset[..., None, :]
        covariance = (weights[..., None] * (self.covariances + outer)).sum(1)
        return mean.double() + self.origin[:, None, :], covariance

    def sample(self, count: int, seeds: Sequence[int]) -> Tensor:
        """Trajectories drawn from the mixture: [N, count, T, 2] float64, m, ground frame.

        A trajectory follows one mode, drawn by weight; one standard normal vector goes through that
        mode's Cholesky factors at all steps. Each step so has exactly the mixture's distribution, and
        the path is smooth.

        Args:
            count: trajectories of each agent.
            seeds: N of them, one an agent, so that an agent's draws do not hang on what else is in the
                batch. Equal seeds give equal noise: agents of one scene should get different ones.
        """
        modes, noise = [], []
        for weights, seed in zip(self.weights.cpu(), seeds, strict=True):
            generator = torch.Generator().manual_seed(seed)
            modes.append(torch.multinomial(weights, count, replacement=True, generator=generator))
            noise.append(torch.randn(count, 2, generator=generator, dtype=self.means.dtype))
        rows, columns = torch.arange(len(self))[:, None], torch.stack(modes)
        factors = cholesky_2x2(self.covariances)
        drawn = self.means[rows, columns]  # [N, S, T, 2]
        one, another = torch.stack(noise)[:, :, None].unbind(-1)  # [N, S, 1] each
        # By hand: a product of 2 × 2 matrices for every step of every sample takes longer
        drawn[..., 0] += factors[..., 0, 0][rows, columns] * one
        drawn[..., 1] += factors[..., 1, 0][rows, columns] * one
        drawn[..., 1] += factors[..., 1, 1][rows, columns] * another
        return drawn.double() + self.origin[:, None, None, :]


def cholesky_2x2(covariances: Tensor) -> Tensor:
    """Lower factors of positive (semi-)definite 2 × 2 matrices: [..., 2, 2] → [..., 2, 2].

    In closed form: rounding may leave a tiny negative pivot, which is cut at zero, where
    ``torch.linalg.cholesky`` would raise. No element of a factor is larger than its row's standard
    deviation, so a variance that has underflowed to zero does no harm either.
    """
    l11 = covariances[..., 0, 0].clamp_min(0).sqrt()
    largest = covariances[..., 1, 1].clamp_min(0).sqrt()
    l21 = covariances[..., 1, 0] / l11.clamp_min(torch.finfo(covariances.dtype).tiny)
    l21 = torch.maximum(torch.minimum(l21, largest), -largest)
    l22 = (covariances[..., 1, 1] - l21.square()).clamp_min(0).sqrt()
    zero = torch.zeros_like(l11)
    return torch.stack([torch.stack([l11, zero], dim=-1), torch.stack([l21, l22], dim=-1)], dim=-2)


LEAST_VARIANCE = 1e-8
"""m², of a density; below it a variance counts as this."""
LEAST_DECORRELATION = 1e-5
"""1 − ρ², of a density; below it an ellipse counts as this slim."""


def guarded_log_density(offset: Tensor, covariance: Tensor) -> Tensor:
    """Log-density of Gaussians that may be degenerate: [...], always finite.

    A step whose spread comes from one control alone has a covariance of rank one. As in the released
    Trajectron++, variances and 1 − ρ² are bounded from below.

    Args:
        offset: [..., 2], m, from the mean.
        covariance: [..., 2, 2], m².
    """
    xx = covariance[..., 0, 0].clamp_min(LEAST_VARIANCE)
    yy = covariance[..., 1, 1].clamp_min(LEAST_VARIANCE)
    sigma = (xx * yy).sqrt()
    rho = covariance[..., 0, 1] / sigma
    free = (1 - rho.square()).clamp(LEAST_DECORRELATION, 1.0)
    dx, dy = offset[..., 0], offset[..., 1]
    squared = (dx.square() / xx + dy.square() / yy - 2 * rho * dx * dy / sigma) / free
    return -0.5 * (squared + (xx * yy * free).log()) - math.log(2 * math.pi)
