"""Calibration after training."""

import copy
import math

import pytest
import torch
from torch import Tensor

from model.forecaster import Context, Features
from model.metrics.density import LABEL_NOISE_M, nll
from model.mixture import TrajectoryMixture
from model.networks.config import BlindContext, NetworkConfig
from model.networks.covernet import CoverNet
from model.networks.cvae import AgentNetwork
from model.networks.dynamics import Positions
from model.scenes.scene import AgentType
from model.training.calibration import (
    MAX_FACTOR,
    MIN_FACTOR,
    Calibration,
    _minimize,
    calibrate,
    fit_calibration,
)
from model.training.config import Method
from model.training.covernet import CoverNetLearner
from tests.model.training.fakes import MadeUpPairs, small_config


@pytest.fixture
def network() -> AgentNetwork:
    """Return a network whose modes differ, in where they lead and in how likely they are."""
    torch.manual_seed(0)
    modes = 5
    network = AgentNetwork(NetworkConfig(modes=modes), AgentType.VEHICLE).eval()
    with torch.no_grad():
        network.prior_logits.weight.mul_(30)
        network.full.decoder.initial_h.weight[:, :modes].mul_(30)
        network.full.decoder.cell.weight_ih[:, :modes].mul_(10)
        network.full.decoder.log_sigma.bias.sub_(2)
    return network


class Drawn(MadeUpPairs):
    """Pairs whose truth is drawn from a network's own forecasts, calibrated otherwise."""

    def __init__(self, pairs: int, network: AgentNetwork, calibration: Calibration) -> None:
        super().__init__(pairs)
        with torch.no_grad():
            log_weights, positions = network(self._features, Context.FULL, 12)
        generator = torch.Generator().manual_seed(1)
        rows = torch.arange(pairs)[:, None]
        # A mode a step: the figure that is fitted is that of single steps
        shares = (log_weights / calibration.temperature).softmax(dim=1)
        mode = torch.multinomial(shares, 12, replacement=True, generator=generator)
        steps = torch.arange(12)[None]
        scale = torch.linalg.cholesky(positions.covariance[rows, mode, steps] + 1e-6 * torch.eye(2))
        noise = torch.randn(pairs, 12, 2, 1, generator=generator)
        self._future = positions.mean[rows, mode, steps] + calibration.width * (scale @ noise)[..., 0]

    def batch(self, indices: Tensor, turns: Tensor | None = None) -> tuple[Features, Tensor]:
        features, _ = super().batch(indices, turns)
        return features, self._future[indices]


@pytest.mark.parametrize("width", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("temperature", [0.5, 1.0, 2.5])
def test_what_the_truth_was_drawn_with_is_found(
    network: AgentNetwork, width: float, temperature: float
) -> None:
    found = fit_calibration(network, Drawn(600, network, Calibration(width, temperature)))
    assert found.width == pytest.approx(width, rel=0.1)
    assert found.temperature == pytest.approx(temperature, rel=0.15)


class Rounded(AgentNetwork):
    """One of whose covariances is so large that rounding has left it without an inverse."""

    def forward(self, features: Features, context: Context, steps: int) -> tuple[Tensor, Positions]:
        log_weights, positions = super().forward(features, context, steps)
        covariance = positions.covariance.clone()
        covariance[0, 0, 0] = torch.tensor([[1e6, -1.001e6], [-1.001e6, 1e6]])
        return log_weights, Positions(positions.mean, covariance)


def test_steps_without_a_density_do_not_count(network: AgentNetwork) -> None:
    pairs = Drawn(600, network, Calibration(2.0, 1.5))
    rounded = Rounded(network.config, AgentType.VEHICLE).eval()
    rounded.load_state_dict(network.state_dict())
    found = fit_calibration(rounded, pairs)
    assert found.width == pytest.approx(2.0, rel=0.1)
    assert found.temperature == pytest.approx(1.5, rel=0.15)


def test_covernet_is_calibrated_by_its_spread_and_its_logits() -> None:
    pairs = MadeUpPairs(12)
    torch.manual_seed(0)
    learner = CoverNetLearner(small_config(Method.COVERNET), pairs.paths, torch.device("cpu"))
    check_built_in(learner.network.eval(), Context.FULL)
    found = fit_calibration(learner.network, pairs)
    assert found.blind_width is None
    before = validation_nll(learner.network, pairs)
    calibrate(learner.network, found)
    assert validation_nll(learner.network, pairs) < before


def validation_nll(network: CoverNet, pairs: MadeUpPairs) -> float:
    """Return the mean over pairs and steps, nats."""
    features, future = pairs.batch(torch.arange(len(pairs)))
    origin = features["origin"]
    with torch.no_grad():
        weights, positions = network(features, Context.FULL, 12)
    mixture = TrajectoryMixture(weights, positions.mean, positions.covariance, origin)
    return float(nll(mixture, (future.double() + origin[:, None]).numpy(), LABEL_NOISE_M).mean())


def test_one_mode_has_no_temperature() -> None:
    network = AgentNetwork(NetworkConfig(modes=1), AgentType.VEHICLE).eval()
    assert fit_calibration(network, MadeUpPairs(6)).temperature == 1.0


@pytest.mark.parametrize("bound", [None, 0.8])
@pytest.mark.parametrize("kind", BlindContext)
def test_what_is_built_in_is_what_was_fitted(kind: BlindContext, bound: float | None) -> None:
    """Covariances and probabilities change as the calibration says; means, and the modes' order, do not."""
    torch.manual_seed(0)
    config = NetworkConfig(modes=5, blind=kind, max_control_sigma=bound)
    network = AgentNetwork(config, AgentType.VEHICLE).eval()
    contexts = (Context.FULL,) if kind is BlindContext.NONE else tuple(Context)
    for context in contexts:
        check_built_in(copy.deepcopy(network), context)


def check_built_in(network: AgentNetwork | CoverNet, context: Context) -> None:
    """Compare a network's forecasts in a context before and after."""
    blind_width = 0.4
    calibration = Calibration(width=1.7, temperature=3.0, blind_width=blind_width)
    features, _ = MadeUpPairs(6).batch(torch.arange(6))
    origin = torch.zeros(6, 2, dtype=torch.float64)
    with torch.no_grad():
        weights, positions = network(features, context, 12)
        own_branch = context is Context.BLIND and getattr(network, "blind", None) is not None
        shown = calibration._replace(width=blind_width) if own_branch else calibration
        expected = shown.apply(TrajectoryMixture(weights, positions.mean, positions.covariance, origin))
        calibrate(network, calibration)
        weights_after, after = network(features, context, 12)
    assert torch.equal(positions.mean, after.mean)
    assert torch.equal(weights.argsort(1), weights_after.argsort(1))
    assert not torch.allclose(weights, weights_after)
    torch.testing.assert_close(weights_after, expected.log_weights)
    torch.testing.assert_close(after.covariance, expected.covariances, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("number", [MIN_FACTOR, MAX_FACTOR])
def test_a_number_at_a_bound_is_known(number: float) -> None:
    found = _minimize(lambda value: abs(math.log(value / number)))
    assert Calibration(found, 1.0).ran_away
    assert Calibration(1.0, found).ran_away
    assert Calibration(1.0, 1.0, found).ran_away
    assert not Calibration(0.2, 50.0, 2.0).ran_away
    assert not Calibration(0.2, 50.0).ran_away
