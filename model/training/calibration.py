"""How wide a trained network's forecasts should be.

An objective that does not count its worst errors (CAB's, Reweight's and RUBiZ's clamp them), or that counts
displacements beside the likelihood, leaves a network too sure of itself. One factor on all standard
deviations, under which training positions are the likeliest, mends the most of that and leaves means and
probabilities as they are (in the way of temperature scaling, Guo et al. 2017, which fits by likelihood, too).
Wide enough for nine of ten positions to lie in the 90 % regions would take more: errors have longer tails
than Gaussians.
"""

import math
from typing import Final

import torch

from model.forecaster import Context
from model.metrics.density import LABEL_NOISE_M, nll
from model.mixture import TrajectoryMixture
from model.networks.network import AgentNetwork
from model.training.source import BatchSource

PAIRS: Final = 2048
"""That the factor is fitted to, spread over the split."""
LEAST, MOST = 0.25, 8.0
"""Bounds of the factor."""
_BATCH: Final = 256
_ROUNDS: Final = 16
_GOLDEN: Final = (math.sqrt(5) - 1) / 2


@torch.no_grad()
def fit_width(network: AgentNetwork, pairs: BatchSource) -> float:
    """The factor on the standard deviations under which the pairs' positions are the likeliest.

    Args:
        network: in evaluation mode.
        pairs: that it was trained on.
    """
    chosen = torch.linspace(0, len(pairs) - 1, min(PAIRS, len(pairs))).long().unique()
    judged = []
    for indices in chosen.split(_BATCH):
        features, future = pairs.batch(indices)
        log_weights, positions = network(features, Context.FULL, future.shape[1])
        parts = (log_weights, positions.mean, positions.covariance, features["origin"])
        truth = (future.double() + features["origin"][:, None]).cpu().numpy()
        judged.append((TrajectoryMixture(*(part.cpu() for part in parts)), truth))

    def unlikely(log_factor: float) -> float:
        total = 0.0
        for mixture, truth in judged:
            wider = TrajectoryMixture(
                mixture.log_weights,
                mixture.means,
                math.exp(2 * log_factor) * mixture.covariances,
                mixture.origin,
            )
            total += float(nll(wider, truth, LABEL_NOISE_M).sum())
        return total

    # Golden-section search: too narrow or too wide, positions are the less likely the more it is so
    low, high = math.log(LEAST), math.log(MOST)
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    of_left, of_right = unlikely(left), unlikely(right)
    for _ in range(_ROUNDS):
        if of_left < of_right:
            high, right, of_right = right, left, of_left
            left = high - _GOLDEN * (high - low)
            of_left = unlikely(left)
        else:
            low, left, of_left = left, right, of_right
            right = low + _GOLDEN * (high - low)
            of_right = unlikely(right)
    return math.exp((low + high) / 2)


@torch.no_grad()
def widen(network: AgentNetwork, factor: float) -> None:
    """Multiplies the standard deviations of all forecasts with full context by a factor.

    Positions' covariances are linear in those of the controls (``model.networks.dynamics``), and only means
    are fed back in prediction: the heads' bias is all that changes.
    """
    network.full.decoder.log_sigma.bias.add_(math.log(factor))
