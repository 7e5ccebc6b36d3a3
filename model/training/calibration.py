"""How sure a trained network's forecasts should be of themselves.

An objective that does not count its worst errors (CAB's, Reweight's and RUBiZ's clamp them), or that counts
displacements beside the likelihood, leaves a network too sure of itself: its Gaussians are too narrow, and
its p(z | x) puts nearly all on one mode. Two numbers, under which training positions are the likeliest, mend
the most of that, and leave means and the order of the modes as they are: a factor on all standard deviations,
and a temperature of the modes' logits (temperature scaling, Guo et al. 2017, section 4.2, which fits by
likelihood, too). Wide enough for nine of ten positions to lie in the 90 % regions would take more: errors
have longer tails than Gaussians.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F

from model.arrays import Floats
from model.forecaster import Context
from model.metrics.density import LABEL_NOISE_M, nll
from model.mixture import TrajectoryMixture
from model.networks.network import AgentNetwork
from model.training.source import BatchSource

PAIRS: Final = 2048
"""That the numbers are fitted to, spread over the split."""
LEAST, MOST = 0.1, 16.0
"""Bounds of either number."""
_BATCH: Final = 256
_TURNS: Final = 3
"""How often each number is fitted with the other one held."""
_ROUNDS: Final = 16
_GOLDEN: Final = (math.sqrt(5) - 1) / 2


class Calibration(NamedTuple):
    """What is done to a network's forecasts; (1, 1) changes nothing."""

    width: float
    """Factor on the standard deviations."""
    temperature: float
    """Divisor of the logits of p(z | x): above 1 the modes' probabilities come nearer to each other."""

    def of(self, mixture: TrajectoryMixture) -> TrajectoryMixture:
        """The forecasts with it."""
        return TrajectoryMixture(
            F.log_softmax(mixture.log_weights / self.temperature, dim=1),
            mixture.means,
            self.width**2 * mixture.covariances,
            mixture.origin,
        )


@torch.no_grad()
def fit_calibration(network: AgentNetwork, pairs: BatchSource) -> Calibration:
    """The one under which the pairs' positions are the likeliest, step by step.

    Args:
        network: in evaluation mode.
        pairs: that it was trained on.
    """
    judged = _forecasts(network, pairs)

    def unlikely(width: float, temperature: float) -> float:
        calibration = Calibration(width, temperature)
        return sum(float(nll(calibration.of(m), truth, LABEL_NOISE_M).sum()) for m, truth in judged)

    width, temperature = 1.0, 1.0
    for _ in range(_TURNS):
        width = _least(partial(unlikely, temperature=temperature))
        temperature = _least(partial(unlikely, width))
    return Calibration(width, temperature)


@torch.no_grad()
def calibrate(network: AgentNetwork, calibration: Calibration) -> None:
    """Builds it into a network's parameters.

    Positions' covariances are linear in those of the controls (``model.networks.dynamics``), and only means
    are fed back in prediction: so the bias of the full context's heads is all that changes of them. The last
    layer of p(z | x) is one for all contexts.
    """
    network.full.decoder.log_sigma.bias.add_(math.log(calibration.width))
    network.prior_logits.weight.div_(calibration.temperature)
    network.prior_logits.bias.div_(calibration.temperature)


def _forecasts(network: AgentNetwork, pairs: BatchSource) -> list[tuple[TrajectoryMixture, Floats]]:
    """With full context, and where the agents went: [N, T, 2], m, ground frame."""
    chosen = torch.linspace(0, len(pairs) - 1, min(PAIRS, len(pairs))).long().unique()
    judged = []
    for indices in chosen.split(_BATCH):
        features, future = pairs.batch(indices)
        log_weights, positions = network(features, Context.FULL, future.shape[1])
        parts = (log_weights, positions.mean, positions.covariance, features["origin"])
        truth = (future.double() + features["origin"][:, None]).cpu().numpy()
        judged.append((TrajectoryMixture(*(part.cpu() for part in parts)), truth))
    return judged


def _least(function: Callable[[float], float]) -> float:
    """Where between ``LEAST`` and ``MOST`` a function is least, to 1 %, if it has one minimum there.

    Golden-section search over the logarithm: too small or too great, positions are the less likely the more
    it is so.
    """
    low, high = math.log(LEAST), math.log(MOST)
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    of_left, of_right = function(math.exp(left)), function(math.exp(right))
    for _ in range(_ROUNDS):
        if of_left < of_right:
            high, right, of_right = right, left, of_left
            left = high - _GOLDEN * (high - low)
            of_left = function(math.exp(left))
        else:
            low, left, of_left = left, right, of_right
            right = low + _GOLDEN * (high - low)
            of_right = function(math.exp(right))
    return math.exp((low + high) / 2)
