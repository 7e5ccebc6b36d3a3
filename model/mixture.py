"""Gaussian mixtures over future positions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class TrajectoryMixture:
    """K modes for each of N agents: a probability, and a 2-D Gaussian at each of T steps.

    Positions are relative to ``origin``, which is the only float64: far from the ground frame's origin,
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
        """Return the mixtures of some of the agents."""
        return TrajectoryMixture(
            self.log_weights[index], self.means[index], self.covariances[index], self.origin[index]
        )

    def cpu(self) -> "TrajectoryMixture":
        """Return the mixture on the CPU."""
        return TrajectoryMixture(
            self.log_weights.cpu(), self.means.cpu(), self.covariances.cpu(), self.origin.cpu()
        )

    def most_likely(self) -> Tensor:
        """Return the mode of greatest weight (the first of equals): [N]."""
        return self.log_weights.argmax(dim=-1)

    def most_likely_trajectory(self) -> Tensor:
        """Return the means of the most likely mode: [N, T, 2] float64, m, ground frame."""
        modes = self.most_likely()
        return self.world_means[torch.arange(len(self)), modes]

    def component_log_density(self, positions: Tensor) -> Tensor:
        """Return the log-density of each mode at each step, without the weights: [N, K, T].

        Args:
            positions: [N, T, 2] float64, m, ground frame.
        """
        relative = (positions - self.origin[:, None, :]).to(self.means.dtype)
        offset = relative[:, None] - self.means
        return guarded_log_density(offset, self.covariances)

    def log_density(self, positions: Tensor) -> Tensor:
        """Return the log-density of the position at each step: [N, T], 1/m² inside the log.

        Args:
            positions: [N, T, 2] float64, m, ground frame.
        """
        return self.log_densities(positions[:, None])[:, 0]

    def log_densities(self, positions: Tensor) -> Tensor:
        """Return ``log_density`` of S trajectories of each agent: [N, S, T].

        Args:
            positions: [N, S, T, 2] float64, m, ground frame.
        """
        relative = (positions - self.origin[:, None, None, :]).to(self.means.dtype)
        offset = relative[:, :, None] - self.means[:, None]
        # What depends on the covariances alone is computed once, not S times
        joint = self.log_weights[:, None, :, None] + guarded_log_density(offset, self.covariances[:, None])
        return torch.logsumexp(joint, dim=2)

    def moments(self) -> tuple[Tensor, Tensor]:
        """Return mean [N, T, 2] (float64, ground frame) and covariance [N, T, 2, 2] of the whole mixture."""
        weights = self.weights[:, :, None, None]
        mean = (weights * self.means).sum(1)
        offset = self.means - mean[:, None]
        outer = offset[..., :, None] * offset[..., None, :]
        covariance = (weights[..., None] * (self.covariances + outer)).sum(1)
        return mean.double() + self.origin[:, None, :], covariance

    def sample(self, count: int, seeds: Sequence[int]) -> Tensor:
        """Sample trajectories: [N, count, T, 2] float64, m, ground frame.

        A trajectory follows one mode, drawn by weight. One standard normal vector is multiplied by that
        mode's Cholesky factors at all steps. So each step has exactly the mixture's distribution, and the
        path is smooth.

        Args:
            count: number of trajectories of each agent.
            seeds: N seeds, one for each agent, so that an agent's samples do not depend on the rest of the
                batch. Equal seeds give equal noise: agents of one scene should have different ones.
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
        # Written out, because a 2 × 2 matrix product for every step of every sample is slower
        drawn[..., 0] += factors[..., 0, 0][rows, columns] * one
        drawn[..., 1] += factors[..., 1, 0][rows, columns] * one
        drawn[..., 1] += factors[..., 1, 1][rows, columns] * another
        return drawn.double() + self.origin[:, None, None, :]


MERGE_DISTANCE_M = 2.0
"""m; maximum distance of a mode from a heavier one that it is merged into."""
MERGE_RELATIVE_DISTANCE = 0.2
"""Maximum distance as a share of the distance that the heavier mode has gone; the larger of both applies."""


@dataclass(frozen=True)
class MergedModes:
    """The distinct modes that a mixture's K modes merge into, at most K', and the group of each mode.

    Agents may have different numbers of distinct modes. An agent's entries beyond ``counts`` are padding:
    their weight is zero (log-weight −inf), and they repeat the agent's first merged mode, so that
    computations over all modes meet only positions that a forecast names.
    """

    mixture: TrajectoryMixture
    """[N, K'], in ascending order of ``mode_ids``."""
    counts: Tensor
    """[N] int64, number of merged modes of each agent."""
    mode_ids: Tensor
    """[N, K'] int64, the index of each group's heaviest mode before merging; −1 in padding."""
    groups: Tensor
    """[N, K] int64, the merged mode of each mode; −1 for a mode whose log-weight is −inf."""


def merge_modes(
    mixture: TrajectoryMixture,
    min_distance_m: float = MERGE_DISTANCE_M,
    relative_distance: float = MERGE_RELATIVE_DISTANCE,
) -> MergedModes:
    """Merge modes that a planner would not distinguish, greedily by probability.

    The heaviest mode is kept, and the modes near it join it; then the heaviest of the rest is kept, and so
    on (the lower index first among equal weights). A mode is near a kept one if, at every step, their means
    are at most max(min_distance_m, relative_distance · d) apart, where d is the distance of the kept mode's
    mean from the origin (the agent's position now) at that step. So two ways around an obstacle remain two
    modes although they end at the same place.

    The weights of a group's members are summed. The kept mode's means represent the group, because a
    weighted mean of paths may not be drivable. A group's covariance is its members' second moment about
    those means. So the mixture's second moment about a group's path is preserved; its mean is not.

    Merging merged modes again may merge more, because the summed weights can change which mode is heavier,
    and the distance that the heavier one has gone decides. With ``relative_distance`` zero it changes
    nothing.

    Args:
        mixture: the mixture; modes with log-weight −inf (the padding of merged modes) are left out.
        min_distance_m: m, at least zero.
        relative_distance: at least zero.

    Raises:
        ValueError: a negative distance.
    """
    if min_distance_m < 0 or relative_distance < 0:
        raise ValueError(f"distances to merge by must not be negative: {min_distance_m}, {relative_distance}")
    # Modes by rank: the heaviest first, the lower index first among equals
    ranked, order = mixture.log_weights.sort(dim=-1, descending=True, stable=True)  # [N, K] each
    by_rank = _leaders(
        _of_modes(mixture.means, order), ranked != -math.inf, min_distance_m, relative_distance
    )
    # The index of the mode that each mode joins: ranks become indices, in the original order of modes
    leaders = torch.empty_like(order).scatter_(1, order, order.gather(1, by_rank))
    # NaN weights stay, so that they show in the result
    alive = mixture.log_weights != -math.inf

    numbers = torch.arange(order.shape[1], device=order.device)
    kept = alive & (leaders == numbers)
    counts = kept.sum(dim=-1)
    groups = (kept.cumsum(dim=-1) - 1).gather(1, leaders).masked_fill(~alive, -1)
    max_count = int(counts.max()) if len(mixture) else 0
    ids = kept.byte().argsort(dim=-1, descending=True, stable=True)[:, :max_count]  # the kept ones come first
    padding = numbers[:max_count] >= counts[:, None]
    ids = torch.where(padding, ids[:, :1], ids)

    # Relative to the heaviest member's weight, so that a mode that nothing joins keeps its weight bit by bit
    heaviest = mixture.log_weights.gather(1, leaders)
    relative = (mixture.log_weights - heaviest).exp().masked_fill(~alive, 0.0)
    totals = torch.zeros_like(relative).scatter_add_(1, leaders, relative)
    log_weights = (mixture.log_weights + totals.log()).gather(1, ids).masked_fill(padding, -math.inf)
    shares = relative / totals.gather(1, leaders).clamp_min(1.0)  # at least 1, except for modes left out

    offset = mixture.means - _of_modes(mixture.means, leaders)  # of each mode from its group's path
    moments = mixture.covariances + offset[..., :, None] * offset[..., None, :]
    moments *= shares[..., None, None, None]
    covariances = torch.zeros_like(moments)
    covariances.flatten(0, 1).index_add_(0, _rows(leaders, leaders.shape[1]), moments.flatten(0, 1))
    return MergedModes(
        TrajectoryMixture(
            log_weights,
            _of_modes(mixture.means, ids),
            _of_modes(covariances, ids),
            mixture.origin,
        ),
        counts,
        ids.masked_fill(padding, -1),
        groups,
    )


def _of_modes(values: Tensor, modes: Tensor) -> Tensor:
    """Select modes [N, J] of each agent from ``values`` [N, K, ...]: [N, J, ...]."""
    # Copying whole rows takes a third of the time of indexing by agent and mode
    rows = values.flatten(0, 1).index_select(0, _rows(modes, values.shape[1]))
    return rows.view(*modes.shape, *values.shape[2:])


def _rows(modes: Tensor, count: int) -> Tensor:
    """Return the positions of modes [N, J] when agents and their ``count`` modes are one axis: [N · J]."""
    return (torch.arange(len(modes), device=modes.device)[:, None] * count + modes).flatten()


def _leaders(means: Tensor, alive: Tensor, min_distance_m: float, relative_distance: float) -> Tensor:
    """Return the rank of the kept mode that each mode joins (its own for a kept mode): [N, K].

    Args:
        means: [N, K, T, 2], by descending weight.
        alive: [N, K], modes of non-zero weight; the others neither join a mode nor are joined.
        min_distance_m: as in ``merge_modes``.
        relative_distance: as in ``merge_modes``.
    """
    # One step at a time and agents last: the working set fits the CPU cache, and inner loops run over agents
    x, y = means.permute(3, 2, 1, 0).contiguous()  # [T, K, N] each
    allowed = (relative_distance * torch.hypot(x, y)).clamp_min(min_distance_m).square()
    # A distance that overflows is near nothing: otherwise covariances would overflow, too
    allowed.clamp_(max=torch.finfo(allowed.dtype).max)
    near = torch.ones(x.shape[1], *x.shape[1:], dtype=torch.bool, device=x.device)
    for east, north, bound in zip(x, y, allowed, strict=True):
        squared = (east[:, None] - east).square_()  # [K, K, N]
        squared += (north[:, None] - north).square_()
        near &= squared <= bound[:, None]
    free = alive.T.clone()
    for rank, joins in enumerate(near):  # a view: row by row, near becomes joins
        joins.logical_and_(free).logical_and_(free[rank])
        free.logical_xor_(joins)
    numbers = torch.arange(len(near), device=near.device)
    leaders = (near * numbers[:, None, None]).amax(dim=0).T  # at most one entry of a mode's column is set
    return torch.where(alive, leaders, numbers)


def cholesky_2x2(covariances: Tensor) -> Tensor:
    """Return the lower Cholesky factors of positive (semi-)definite 2 × 2 matrices: [..., 2, 2].

    The closed form clamps a tiny negative pivot, which rounding may leave, at zero;
    ``torch.linalg.cholesky`` would raise. No element of a factor is larger than its row's standard
    deviation, so that a variance which underflows to zero is harmless, too.
    """
    l11 = covariances[..., 0, 0].clamp_min(0).sqrt()
    largest = covariances[..., 1, 1].clamp_min(0).sqrt()
    l21 = covariances[..., 1, 0] / l11.clamp_min(torch.finfo(covariances.dtype).tiny)
    l21 = torch.maximum(torch.minimum(l21, largest), -largest)
    l22 = (covariances[..., 1, 1] - l21.square()).clamp_min(0).sqrt()
    zero = torch.zeros_like(l11)
    return torch.stack([torch.stack([l11, zero], dim=-1), torch.stack([l21, l22], dim=-1)], dim=-2)


MIN_VARIANCE = 1e-8
"""m²; minimum variance in a density."""
MIN_DECORRELATION = 1e-5
"""Minimum of 1 − ρ² in a density."""


def guarded_log_density(offset: Tensor, covariance: Tensor) -> Tensor:
    """Return the log-density of Gaussians that may be degenerate: [...], always finite.

    A step whose spread comes from one control alone has a covariance of rank one. As in the released
    Trajectron++, variances and 1 − ρ² are bounded from below.

    Args:
        offset: [..., 2], m, from the mean.
        covariance: [..., 2, 2], m².
    """
    xx = covariance[..., 0, 0].clamp_min(MIN_VARIANCE)
    yy = covariance[..., 1, 1].clamp_min(MIN_VARIANCE)
    sigma = (xx * yy).sqrt()
    rho = covariance[..., 0, 1] / sigma
    free = (1 - rho.square()).clamp(MIN_DECORRELATION, 1.0)
    dx, dy = offset[..., 0], offset[..., 1]
    squared = (dx.square() / xx + dy.square() / yy - 2 * rho * dx * dy / sigma) / free
    return -0.5 * (squared + (xx * yy * free).log()) - math.log(2 * math.pi)
