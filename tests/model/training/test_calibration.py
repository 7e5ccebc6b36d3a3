"""The width of forecasts, fitted after training."""

import pytest
import torch
from torch import Tensor

from model.forecaster import Context, Features
from model.networks.config import NetworkConfig
from model.networks.network import AgentNetwork
from model.scene import AgentType
from model.training.calibration import fit_width, widen
from tests.model.training.fakes import MadeUpPairs


@pytest.fixture
def network() -> AgentNetwork:
    torch.manual_seed(0)
    return AgentNetwork(NetworkConfig(modes=5), AgentType.VEHICLE).eval()


class Drawn(MadeUpPairs):
    """Pairs whose truth is drawn from a network's own forecasts, made wider."""

    def __init__(self, pairs: int, network: AgentNetwork, factor: float) -> None:
        super().__init__(pairs)
        with torch.no_grad():
            log_weights, positions = network(self._features, Context.FULL, 12)
        generator = torch.Generator().manual_seed(1)
        rows = torch.arange(pairs)[:, None]
        # A mode a step: the figure that is fitted is that of single steps
        mode = torch.multinomial(log_weights.exp(), 12, replacement=True, generator=generator)
        steps = torch.arange(12)[None]
        scale = torch.linalg.cholesky(positions.covariance[rows, mode, steps] + 1e-6 * torch.eye(2))
        noise = torch.randn(pairs, 12, 2, 1, generator=generator)
        self._future = positions.mean[rows, mode, steps] + factor * (scale @ noise)[..., 0]

    def batch(self, indices: Tensor, turns: Tensor | None = None) -> tuple[Features, Tensor]:
        features, _ = super().batch(indices, turns)
        return features, self._future[indices]


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_the_width_that_the_truth_has_is_found(network: AgentNetwork, factor: float) -> None:
    assert fit_width(network, Drawn(300, network, factor)) == pytest.approx(factor, rel=0.1)


def test_widening_changes_covariances_and_nothing_else(network: AgentNetwork) -> None:
    features, _ = MadeUpPairs(6).batch(torch.arange(6))
    with torch.no_grad():
        weights, positions = network(features, Context.FULL, 12)
        widen(network, 1.7)
        weights_after, after = network(features, Context.FULL, 12)
    assert torch.equal(weights, weights_after)
    assert torch.equal(positions.mean, after.mean)
    assert torch.allclose(after.covariance, 1.7**2 * positions.covariance, rtol=1e-4, atol=1e-6)
