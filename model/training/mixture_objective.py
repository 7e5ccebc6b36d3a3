"""Objective of networks in the agent's frame: a mixture whose modes differ and whose weights are meaningful.

Its terms were chosen by experiment (``docs/experiments.md``): the likelihood of the mixture with weights
p(z | x), the distance of the nearest mode (winner takes all: multiple choice learning, Guzman-Rivera et al.
2012, as in MTP and MultiPath), the classification of the nearest modes, and the distance from the truth
expected under the probabilities, which makes the likeliest mode a near one. Methods with a blind forecast add
the same terms for it, and their own one: CAB the KL term ``objectives.cab_kl``, Reweight a larger weight of
what the blind forecast misses, RUBiZ the likelihood under fused latents (Ben-Younes et al. 2022, section 3).
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from model.features.agent_features import NEIGHBOR_VELOCITY_SCALE
from model.forecaster import Context, Features
from model.networks.agent_frame import AgentFrameNetwork, Modes, Path, drives_through, read_patch
from model.scenes.raster import FAR
from model.training.config import BLIND, Method, MixtureWeights
from model.training.objectives import RUBIZ_FULL, Loss, cab_kl, fused_log_weights

_LEFT = 0.2
"""A neighbour has left if the true path overlaps its place by more than this (``drives_through``)."""
_STANDING_MPS = 0.5
"""m/s; a slower neighbour stands."""


class _Terms(NamedTuple):
    value: Tensor
    named: dict[str, Tensor]
    log_weights: Tensor
    """[N, K]."""
    density: Tensor
    """[N, K, T], log-density of the true position under each mode."""
    log_likelihood: Tensor
    """[N], nats, of a step, averaged over the steps."""


def mixture_objective(
    network: AgentFrameNetwork, features: Features, future: Tensor, weights: MixtureWeights, method: Method
) -> Loss:
    """Return the loss of a batch.

    Methods with a blind forecast add the terms of that forecast and their own term: CAB its KL term
    (``objectives.cab_kl``), Reweight and RUBiZ those of ``objectives.reweight`` and ``objectives.rubiz``.

    Args:
        network: the network, in training mode.
        features: features of N agents, full context.
        future: [N, T, 2], m, in the agents' frames, relative to now.
        weights: weights of the terms.
        method: the method; HalentNet's adversarial terms are not part of this loss.
    """
    full = _terms(network, features, future, weights, Context.FULL)
    if method not in BLIND:
        return Loss(full.value, full.named)
    some = slice(0, max(1, round(weights.blind_share * len(future))))
    part = {name: values[some] for name, values in features.items()}
    blind = _terms(network, part, future[some], weights, Context.BLIND)
    value = full.value + weights.blind * blind.value
    if method is Method.CAB:
        kl = cab_kl(full.log_weights[some], blind.log_weights)
        value, own = value - weights.blind_kl * kl, {"kl_full_blind": kl}
    elif method is Method.REWEIGHT:
        share = torch.sigmoid(-blind.log_likelihood).detach()
        value = value - weights.nll * (share * full.log_likelihood[some]).mean()
        own = {"share": share.mean()}
    else:
        # Near-uniform probabilities of the fused latent would pull all modes together by the expected
        # distance, so its likelihood alone counts
        fused = fused_log_weights(full.log_weights[some], blind.log_weights)
        fused_nll = -torch.logsumexp(fused[..., None] + full.density[some], dim=1).mean()
        own_nll = -full.log_likelihood.mean()
        value = value + weights.nll * (fused_nll - (1 - RUBIZ_FULL) * own_nll)
        own = {"nll_fused": fused_nll}
    named = {
        f"{name}_{which}": term
        for which, one in (("full", full), ("blind", blind))
        for name, term in one.named.items()
    }
    return Loss(value, named | {name: term.detach() for name, term in own.items()})


def _terms(
    network: AgentFrameNetwork, features: Features, future: Tensor, weights: MixtureWeights, context: Context
) -> _Terms:
    branch, seen = network.branch(context)
    modes = branch.decode(branch.encode(features, seen), features, seen)
    log_weights = F.log_softmax(modes.logits, dim=-1)
    density = step_log_density(branch, modes, future)
    log_likelihood = torch.logsumexp(log_weights[..., None] + density, dim=1).mean(dim=-1)
    nll = -log_likelihood.mean()
    distance, proposed = _distances(modes.path, future), _distances(modes.proposal, future)
    mean_distance = distance.mean(dim=-1)
    # The last step weighs more: modes that differ only there are different modes
    score = (mean_distance + 0.5 * distance[..., -1]).detach()
    nearest = score.argmin(dim=1, keepdim=True)
    pulled = mean_distance.gather(1, nearest).mean()
    ranked = log_weights.argsort(dim=1, descending=True)
    expected = (log_weights.exp() * mean_distance).sum(dim=1).mean()
    value = weights.nll * nll + weights.min_ade * pulled + weights.expected_ade * expected
    of_proposal = proposed.mean(dim=-1)
    value = value + weights.proposal * (
        weights.min_ade * of_proposal.gather(1, nearest).mean()
        + weights.expected_ade * (log_weights.exp().detach() * of_proposal).sum(dim=1).mean()
    )
    named = {"nll": nll, "nearest_m": pulled, "expected_m": expected}
    for count, weight in (
        (1, weights.most_likely_ade),
        (5, weights.min_ade_5),
        (10, weights.min_ade_10),
    ):
        if weight:
            first = ranked[:, :count]
            chosen = first.gather(1, score.gather(1, first).argmin(dim=1, keepdim=True))
            distance_m = mean_distance.gather(1, chosen).mean()
            value = value + weight * distance_m
            named[f"nearest_of_{count}_m"] = distance_m
    if weights.joint_nll:
        steps = future.shape[1]
        joint = -torch.logsumexp(log_weights + density.sum(dim=-1), dim=1).mean() / steps
        value = value + weights.joint_nll * joint
        named["joint_nll"] = joint
    if weights.classification:
        target = F.softmax(-score / weights.classification_range_m, dim=1)
        classification = -(target * log_weights).sum(dim=1).mean()
        value = value + weights.classification * classification
        named["choice"] = classification
    if weights.off_road and context is Context.FULL and "far_map" in features:
        road = read_patch(features["far_map"], modes.path.x, modes.path.y, FAR)[:, 0]
        off = (log_weights.exp() * F.relu(-road).amax(dim=-1)).sum(dim=1).mean()
        value = value + weights.off_road * off
        named["off_road"] = off
    if weights.collision and context is Context.FULL and "neighbors" in features:
        met = _meets_standing(modes.path, future, features["neighbors"])
        collision = (log_weights.exp() * met).sum(dim=1).mean()
        value = value + weights.collision * collision
        named["collision"] = collision
    named = {name: term.detach() for name, term in named.items()}
    return _Terms(value, named, log_weights, density, log_likelihood)


def _meets_standing(path: Path, future: Tensor, neighbors: Tensor) -> Tensor:
    """Return by how much each mode drives through a standing neighbour: [N, K], 0 to 1.

    Neighbours that the true path drives through do not count, as they have left.
    """
    x, y = future[:, None].unbind(-1)
    moved_x, moved_y = (torch.diff(part, prepend=torch.zeros_like(part[..., :1])) for part in (x, y))
    truth = Path(x, y, torch.atan2(moved_y, moved_x), torch.zeros_like(x))
    left = drives_through(truth, neighbors) > _LEFT
    speed = NEIGHBOR_VELOCITY_SCALE * neighbors[..., 4:6].norm(dim=-1)
    stands = (neighbors[..., -1] > 0) & (speed < _STANDING_MPS) & ~left[:, 0]
    # Few neighbours stand, so each of them is compared with its agent's modes alone
    agent, neighbor = stands.nonzero(as_tuple=True)
    paths = Path(*(part[agent] for part in path))
    through = drives_through(paths, neighbors[agent, neighbor][:, None])[..., 0]  # [standing, K]
    met = path.x.new_zeros(path.x.shape[:2])
    return met.scatter_reduce(0, agent[:, None].expand_as(through), through, "amax")


def step_log_density(network: AgentFrameNetwork, modes: Modes, future: Tensor) -> Tensor:
    """Return the log-density of the true position under each mode at each step: [N, K, T], 1/m² inside the
    log; the network's floor is added to the variances."""
    ahead, left = (future[:, None, :, axis] - part for axis, part in enumerate((modes.path.x, modes.path.y)))
    cos, sin = modes.path.heading.cos(), modes.path.heading.sin()
    along, across = cos * ahead + sin * left, cos * left - sin * ahead
    variance = modes.sigma.square() + network.variance_floor[:, None]
    squared = along.square() / variance[..., 0] + across.square() / variance[..., 1]
    return -0.5 * (squared + variance.log().sum(dim=-1)) - math.log(2 * math.pi)


def _distances(path: Path, future: Tensor) -> Tensor:
    """Return the distance of each mode from the truth at each step: [N, K, T], m."""
    squared = (future[:, None, :, 0] - path.x).square() + (future[:, None, :, 1] - path.y).square()
    return (squared + 1e-6).sqrt()  # the root has no gradient at zero
