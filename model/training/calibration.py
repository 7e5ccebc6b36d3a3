"""Calibration of a trained network's uncertainty.

An objective that ignores the worst errors (CAB's, Reweight's and RUBiZ's clamp them), or that counts
displacements beside the likelihood, leaves a network overconfident: its Gaussians are too narrow, and
p(z | x) is nearly all on one mode. CoverNet's spread is that about the nearest of its trajectories, not about
the one that it considers the likeliest. Two numbers, chosen by maximum likelihood, correct most of this and
leave the means and the order of the modes as they are: a factor on all standard deviations, and a temperature
of the modes' logits (temperature scaling, Guo et al. 2017, section 4.2, also fitted by likelihood).
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
from model.networks.cvae import AgentNetwork
from model.networks.decoder import ModeDecoder
from model.networks.forecaster import network_mixture
from model.training.sampling import BatchSource

PAIRS: Final = 2048
"""Number of pairs, spread over the split, that the calibration is fitted to."""
MIN_FACTOR, MAX_FACTOR = 0.1, 100.0
"""Bounds of the search for the width and the temperature."""
_NEAR: Final = 1.02
"""A number within this factor of a bound counts as at the bound."""
_BATCH: Final = 256
_TURNS: Final = 3
"""Number of times that each number is fitted while the other one is fixed."""
_ROUNDS: Final = 18
_GOLDEN: Final = (math.sqrt(5) - 1) / 2


class Calibration(NamedTuple):
    """Calibration of a network of the ground frame; (1, 1) changes nothing."""

    width: float
    """Factor on the standard deviations."""
    temperature: float
    """Divisor of the modes' logits; above 1 it evens out their probabilities."""
    blind_width: float | None = None
    """Factor on the standard deviations of blind forecasts, if the network has a branch of its own for them;
    the last layer of p(z | x), and so the temperature, is shared."""

    @property
    def ran_away(self) -> bool:
        """True if a number reached a bound: no factor, or no temperature, suits the network's forecasts."""
        numbers = (self.width, self.temperature, self.blind_width or 1.0)
        return any(not MIN_FACTOR * _NEAR < number < MAX_FACTOR / _NEAR for number in numbers)

    def apply(self, mixture: TrajectoryMixture) -> TrajectoryMixture:
        """Return calibrated forecasts (those with full context)."""
        return TrajectoryMixture(
            F.log_softmax(mixture.log_weights / self.temperature, dim=1),
            mixture.means,
            self.width**2 * mixture.covariances,
            mixture.origin,
        )


class HorizonCalibration(NamedTuple):
    """Calibration of a network of the agent's frame."""

    widths: tuple[float, ...]
    """Factor on the standard deviations at each step, above the network's floor."""
    temperature: float
    """Divisor of the modes' logits."""

    @property
    def ran_away(self) -> bool:
        """True if a number reached a bound of its search."""
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
    """Return the widths and the temperature of maximum likelihood of the pairs' positions.

    The likelihood is that of the merged forecast (``model.mixture.merge_modes``).

    Args:
        network: the network, in evaluation mode, not calibrated yet.
        pairs: pairs that the network was not trained on.
    """
    forecasts = _forecast_paths(network, pairs)
    widths, temperature = torch.ones_like(network.width), 1.0
    for _ in range(_TURNS):
        by_width = torch.stack(
            [_nll_by_step(network, forecasts, w * torch.ones_like(widths), temperature) for w in _WIDTHS]
        )
        widths = torch.tensor(_WIDTHS)[by_width.argmin(dim=0)]
        by_temperature = [
            _nll_by_step(network, forecasts, widths, one).mean().item() for one in _TEMPERATURES
        ]
        temperature = _TEMPERATURES[int(np.argmin(by_temperature))]
    return HorizonCalibration(tuple(widths.tolist()), temperature)


_PathForecasts = Sequence[tuple[Modes, Floats]]
"""Forecasts and true positions [N, T, 2], m, in the agents' frames."""


def _forecast_paths(network: AgentFrameNetwork, pairs: BatchSource) -> _PathForecasts:
    """Return the network's forecasts of some pairs, spread over the split."""
    # The challenge selects moving agents, so that those that leave are overrepresented
    everyday = (~pairs.leaving).nonzero()[:, 0]
    chosen = everyday[torch.linspace(0, len(everyday) - 1, min(PAIRS, len(everyday))).long().unique()]
    forecasts = []
    for indices in chosen.split(_BATCH):
        features, future = pairs.batch(indices)
        modes = network.decode(network.encode(features, Context.FULL), features, Context.FULL)
        truth = turned(future, -features["heading"].to(future.dtype))
        forecasts.append((modes, truth.double().cpu().numpy()))
    return forecasts


def _nll_by_step(
    network: AgentFrameNetwork, forecasts: _PathForecasts, widths: Tensor, temperature: float
) -> Tensor:
    """Return the mean negative log-likelihood of merged forecasts at each step: [T], nats."""
    kept = network.width.clone()
    network.width.copy_(widths)
    steps = []
    for modes, truth in forecasts:
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
    """Apply a calibration to a network's buffers, and to those of its own blind branch, if it has one."""
    for one in (network, network.blind_network):
        if one is not None:
            one.width.mul_(torch.tensor(calibration.widths, device=one.width.device))
            one.temperature.mul_(calibration.temperature)


@torch.no_grad()
def fit_calibration(network: AgentNetwork | CoverNet, pairs: BatchSource) -> Calibration:
    """Return the calibration of maximum likelihood of the pairs' positions, steps taken singly.

    Args:
        network: the network, in evaluation mode.
        pairs: pairs that the network was trained on.
    """
    forecasts = _forecasts(network, pairs, Context.FULL)
    width, temperature = 1.0, 1.0
    for _ in range(_TURNS):
        width = _minimize(partial(_mean_nll, forecasts, temperature=temperature))
        if network.config.modes > 1:
            temperature = _minimize(partial(_mean_nll, forecasts, width))
    if isinstance(network, CoverNet) or network.blind is None:
        return Calibration(width, temperature)
    blind = _forecasts(network, pairs, Context.BLIND)
    return Calibration(width, temperature, _minimize(partial(_mean_nll, blind, temperature=temperature)))


@torch.no_grad()
def calibrate(network: AgentNetwork | CoverNet, calibration: Calibration) -> None:
    """Apply a calibration to a network's parameters.

    The positions' covariances are linear in those of the controls (``model.networks.dynamics``), and only
    means are fed back in prediction. So only the bias of the controls' head, and their bound, change.
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


_Forecasts = Sequence[tuple[TrajectoryMixture, Floats]]
"""Forecasts and true positions [N, T, 2], m, ground frame."""


def _mean_nll(forecasts: _Forecasts, width: float, temperature: float) -> float:
    """Return the mean negative log-likelihood of a step under a calibration, nats.

    Steps without a density, because of rounding (a mode is kilometres wide), do not count, as in the metrics.
    """
    calibration = Calibration(width, temperature)
    steps = [nll(calibration.apply(mixture), truth, LABEL_NOISE_M) for mixture, truth in forecasts]
    return float(np.nanmean(np.concatenate(steps)))


def _forecasts(network: AgentNetwork | CoverNet, pairs: BatchSource, context: Context) -> _Forecasts:
    """Return the network's forecasts of some pairs, spread over the split, in one context."""
    chosen = torch.linspace(0, len(pairs) - 1, min(PAIRS, len(pairs))).long().unique()
    forecasts = []
    for indices in chosen.split(_BATCH):
        features, future = pairs.batch(indices)
        mixture = network_mixture(network, features, context, future.shape[1])
        truth = (future.double() + features["origin"][:, None]).cpu().numpy()
        forecasts.append((mixture.cpu(), truth))
    return forecasts


def _minimize(function: Callable[[float], float]) -> float:
    """Return the argument between ``MIN_FACTOR`` and ``MAX_FACTOR`` that minimises a function, to 1 %.

    Golden-section search over the logarithm; it assumes a single minimum.
    """
    low, high = math.log(MIN_FACTOR), math.log(MAX_FACTOR)
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
