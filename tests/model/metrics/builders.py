"""Mixtures and maps for the tests of metrics."""

import numpy as np
import torch

from model.arrays import Bytes
from model.mixture import TrajectoryMixture
from model.scenes.scene import Raster


def random_mixture(seed: int, agents: int = 3, modes: int = 4, steps: int = 12) -> TrajectoryMixture:
    """Return well-conditioned Gaussians, float64."""
    generator = torch.Generator().manual_seed(seed)
    shape = (agents, modes, steps)
    factor = torch.randn(*shape, 2, 2, generator=generator, dtype=torch.float64)
    return TrajectoryMixture(
        log_weights=torch.randn(agents, modes, generator=generator, dtype=torch.float64).log_softmax(-1),
        means=5 * torch.randn(*shape, 2, generator=generator, dtype=torch.float64),
        covariances=factor @ factor.mT + 0.2 * torch.eye(2, dtype=torch.float64),
        origin=100 * torch.randn(agents, 2, generator=generator, dtype=torch.float64),
    )


def certain(mixture: TrajectoryMixture) -> TrajectoryMixture:
    """Return a mixture without any spread within a mode."""
    return TrajectoryMixture(
        mixture.log_weights, mixture.means, torch.zeros_like(mixture.covariances), mixture.origin
    )


def raster(driveable: Bytes, pixels_per_meter: float = 1.0, origin: tuple[float, float] = (0, 0)) -> Raster:
    """Return a map of one layer [rows, columns]; the other two are empty."""
    layers = np.stack([driveable, np.zeros_like(driveable), np.zeros_like(driveable)])
    return Raster(layers, np.array(origin, dtype=np.float64), pixels_per_meter)
