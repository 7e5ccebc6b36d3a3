"""How sure a trained network's forecasts should be of themselves.

An objective that does not count its worst errors (CAB's, Reweight's and RUBiZ's clamp them), or that counts
displacements beside the likelihood, leaves a network too sure of itself: its Gaussians are too narrow, and
its p(z | x) puts nearly all on one mode. CoverNet's spread is that about the nearest of its trajectories, not
about the one that it takes for the likeliest. Two numbers, under which training positions are the likeliest,
mend the most of that, and leave means and the order of the modes as they are: a factor on all standard
deviations, and a temperature of the modes' logits (temperature scaling, Guo et al. 2017, section 4.2, which
fits by likelihood, too).
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple, TypeAlias

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from model.arrays import Floats
from model.forecaster import Context
from model.metrics.density import LABEL_NOISE_M, nll
from model.mixture import TrajectoryMixture, merge_modes
from model.networks.agent_frame import AgentFrameNetwork, Modes
from model.networks.covernet import CoverNet, turned
from model.networks.decoder import ModeDecoder
from model.networks.forecaster import network_mixture
from model.networks.network import AgentNetwork
from model.training.source import BatchSource

PAIRS: Final = 2048
"""That the numbers are fitted to, spread over the split."""
LEAST, MOST = 0.1, 100.0
"""Bounds of the numbers."""
_NEAR: Final = 1.02
"""A factor; within it of a bound is at the bound."""
_BATCH: Final = 256
_TURNS: Final = 3
"""How often each number is fitted with the other one held."""
_ROUNDS: Final = 18
_GOLDEN: Final = (math.sqrt(5) - 1) / 2


class Calibration(NamedTuple):
    """What is done to a network's forecasts; (1, 1) changes nothing."""

    width: float
    """Factor on the standard deviations."""
    temperature: float
    """Divisor of the modes' logits: above 1 their probabilities come nearer to each other."""
    blind_width: float | None = None
    """Factor on the standard deviations of blind forecasts, where the network has a branch of its own for
    them; what comes last in p(z | x) is one for both."""

    @property
    def ran_away(self) -> bool:
        """Whether a number came to a bound: no factor, or no temperature, suits what the network says."""
        numbers = (self.width, self.temperature, self.blind_width or 1.0)
        return any(not LEAST * _NEAR < number < MOST / _NEAR for number in numbers)

    def of(self, mixture: TrajectoryMixture) -> TrajectoryMixture:
        """Forecasts of full context with it."""
        return TrajectoryMixture(
            F.log_softmax(mixture.log_weights / self.temperature, dim=1),
            mixture.means,
            self.width**2 * mixture.covariances,
            mixture.origin,
        )


class HorizonCalibration(NamedTuple):
    """What is done to the forecasts of a network in the agent's frame."""

    widths: tuple[float, ...]
    """Factor on the standard deviations at each step, above the network's floor."""
    temperature: float
    """Divisor of the modes' logits."""

    @property
    def ran_away(self) -> bool:
        """Whether a number came to a bound of its search."""
        return any(
            not numbers[0] * _NEAR < number < numbers[-1] / _NEAR
            for numbers, fitted in ((_WIDTHS, self.widths), (_TEMPERATURES, (self.temperature,)))
            for number in fitted
        )


AnyCalibration: TypeAlias = Calibration | HorizonCalibration

_WIDTHS: Final = tuple(0.4 * 1.04**power for power in range(60))
_TEMPERATURES: Final = tuple(0.4 * 1.06**power for power in range(50))


@torch.no_grad()
def fit_by_horizon(network: AgentFrameNetwork, pairs: BatchSource) -> HorizonCalibration:
    """Return the widths and the temperature under which the pairs' positions are the likeliest, once modes
    that a planner would not tell apart have been merged.

    Args:
        network: in evaluation mode, not calibrated yet.
        pairs: that it was not trained on.
    """
    judged = _judge_paths(network, pairs)
    widths, temperature = torch.ones_like(network.width), 1.0
    for _ in range(_TURNS):
        by_width = torch.stack(
            [_unlikely_steps(network, judged, w * torch.ones_like(widths), temperature) for w in _WIDTHS]
        )
        widths = torch.tensor(_WIDTHS)[by_width.argmin(dim=0)]
        by_temperature = [
            _unlikely_steps(network, judged, widths, one).mean().item() for one in _TEMPERATURES
        ]
        temperature = _TEMPERATURES[int(np.argmin(by_temperature))]
    return HorizonCalibration(tuple(widths.tolist()), temperature)


_JudgedPaths = Sequence[tuple[Modes, Floats]]
"""Forecasts in the agents' frames, and where the agents went: [N, T, 2], m."""


def _judge_paths(network: AgentFrameNetwork, pairs: BatchSource) -> _JudgedPaths:
    everyday = (~pairs.leaving).nonzero()[:, 0]  # the challenge picks what moves
    chosen = everyday[torch.linspace(0, len(everyday) - 1, min(PAIRS, len(everyday))).long().unique()]
    judged = []
    for indices in chosen.split(_BATCH):
        features, future = pairs.batch(indices)
        modes = network.decode(network.encode(features, Context.FULL), features, Context.FULL)
        truth = turned(future, -features["heading"].to(future.dtype))
        judged.append((modes, truth.double().cpu().numpy()))
    return judged


def _unlikely_steps(
    network: AgentFrameNetwork, judged: _JudgedPaths, widths: Tensor, temperature: float
) -> Tensor:
    """Return the mean negative log-likelihood of merged forecasts at each step: [T]."""
    kept = network.width.clone()
    network.width.copy_(widths)
    steps = []
    for modes, truth in judged:
        mixture = TrajectoryMixture(
            F.log_softmax(modes.logits / temperature, dim=1).cpu(),
            torch.stack([modes.path.x, modes.path.y], dim=-1).cpu(),
            network.covariance(modes).cpu(),
            torch.zeros(len(truth), 2, dtype=torch.float64),
        )
        steps.append(nll(merge_modes(mixture).mixture, truth, LABEL_NOISE_M))
    network.width.copy_(kept)
    return torch.from_numpy(np.nanmean(np.concatenate(steps), axis=0))


@torch.no_grad()
def calibrate_by_horizon(network: AgentFrameNetwork, calibration: HorizonCalibration) -> None:
    """Build a calibration into a network's buffers."""
    network.width.mul_(torch.tensor(calibration.widths, device=network.width.device))
    network.temperature.mul_(calibration.temperature)


@torch.no_grad()
def fit_calibration(network: AgentNetwork | CoverNet, pairs: BatchSource) -> Calibration:
    """The one under which the pairs' positions are the likeliest, step by step.

    Args:
        network: in evaluation mode.
        pairs: that it was trained on.
    """
    judged = _forecasts(network, pairs, Context.FULL)
    width, temperature = 1.0, 1.0
    for _ in range(_TURNS):
        width = _least(partial(_unlikely, judged, temperature=temperature))
        if network.config.modes > 1:
            temperature = _least(partial(_unlikely, judged, width))
    if isinstance(network, CoverNet) or network.blind is None:
        return Calibration(width, temperature)
    blind = _forecasts(network, pairs, Context.BLIND)
    return Calibration(width, temperature, _least(partial(_unlikely, blind, temperature=temperature)))


@torch.no_grad()
def calibrate(network: AgentNetwork | CoverNet, calibration: Calibration) -> None:
    """Builds it into a network's parameters.

    Positions' covariances are linear in those of the controls (``model.networks.dynamics``), and only means
    are fed back in prediction: so their heads' bias, and their bound, is all that changes.
    """
    logits = network.logits if isinstance(network, CoverNet) else network.prior_logits
    logits.weight.div_(calibration.temperature)
    logits.bias.div_(calibration.temperature)
    if isinstance(network, CoverNet):
        network.variance.mul_(calibration.width**2)
        return
    _widen(network.full.decoder, calibration.width)
    if network.blind is not None and calibration.blind_width is not None:
        _widen(network.blind.decoder, calibration.blind_width)


def _widen(decoder: ModeDecoder, factor: float) -> None:
    decoder.log_sigma.bias.add_(math.log(factor))
    if decoder.log_sigma_bound is not None:
        decoder.log_sigma_bound.add_(math.log(factor))


_Judged = Sequence[tuple[TrajectoryMixture, Floats]]
"""Forecasts, and where the agents went: [N, T, 2], m, ground frame."""


def _unlikely(judged: _Judged, width: float, temperature: float) -> float:
    """Mean negative log-likelihood of a step, calibrated so.

    Steps at which rounding leaves no density (a mode is kilometres wide) do not count, as in the metrics.
    """
    calibration = Calibration(width, temperature)
    steps = [nll(calibration.of(mixture), truth, LABEL_NOISE_M) for mixture, truth in judged]
    return float(np.nanmean(np.concatenate(steps)))


def _forecasts(network: AgentNetwork | CoverNet, pairs: BatchSource, context: Context) -> _Judged:
    """Of some of the pairs, in one context."""
    chosen = torch.linspace(0, len(pairs) - 1, min(PAIRS, len(pairs))).long().unique()
    judged = []
    for indices in chosen.split(_BATCH):
        features, future = pairs.batch(indices)
        mixture = network_mixture(network, features, context, future.shape[1])
        truth = (future.double() + features["origin"][:, None]).cpu().numpy()
        judged.append((mixture.cpu(), truth))
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
