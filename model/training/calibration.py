"""How wide a trained network's forecasts should be.

An objective that does not count its worst errors (CAB's, Reweight's and RUBiZ's clamp them) leaves a network
too sure of itself. One factor on all standard deviations, so that nine of ten training positions lie in the
regions that are said to hold 90 %, mends that and leaves means and probabilities as they are (in the way of
temperature scaling, Guo et al. 2017).
"""

import math
from typing import Final

import torch

from model.forecaster import Context
from model.metrics.density import LABEL_NOISE_M, density_rank, inside_region
from model.mixture import TrajectoryMixture
from model.networks.network import AgentNetwork
from model.training.source import BatchSource

PAIRS: Final = 512
"""That the factor is fitted to, spread over the split."""
LEVEL: Final = 0.9
LEAST, MOST = 0.25, 8.0
"""Bounds of the factor."""
_DRAWS: Final = 99
_BATCH: Final = 256
_ROUNDS: Final = 9


@torch.no_grad()
def fit_width(network: AgentNetwork, pairs: BatchSource) -> float:
    """The factor on the standard deviations under which 90 % regions hold 90 % of the pairs' positions.

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
        judged.append((TrajectoryMixture(*(part.cpu() for part in parts)), truth, indices.tolist()))

    def held(factor: float) -> float:
        inside = 0.0
        for mixture, truth, seeds in judged:
            wider = TrajectoryMixture(
                mixture.log_weights, mixture.means, factor**2 * mixture.covariances, mixture.origin
            )
            rank = density_rank(wider, truth, seeds, LABEL_NOISE_M, _DRAWS)
            inside += float(inside_region(rank, LEVEL).mean()) * len(seeds)
        return inside / len(chosen)

    low, high = math.log(LEAST), math.log(MOST)
    for _ in range(_ROUNDS):
        middle = (low + high) / 2
        low, high = (middle, high) if held(math.exp(middle)) < LEVEL else (low, middle)
    return math.exp((low + high) / 2)


@torch.no_grad()
def widen(network: AgentNetwork, factor: float) -> None:
    """Multiplies the standard deviations of all forecasts with full context by a factor.

    Positions' covariances are linear in those of the controls (``model.networks.dynamics``), and only means
    are fed back in prediction: the heads' bias is all that changes.
    """
    network.full.decoder.log_sigma.bias.add_(math.log(factor))
