"""Judges networks on a split."""

import numpy as np
import torch

from model.cvae import CvaeNetworks
from model.data.batches import Batches
from model.data.cache import Cache
from model.forecaster import Context
from model.metrics.aggregate import MetricMeans
from model.metrics.evaluate import instance_metrics
from model.mixture import TrajectoryMixture
from model.networks.config import NetworkConfig
from model.scene import AgentType

BATCH = 512


class Validation:
    """Figures of networks on the pairs of a cache, by the metrics of ``model.metrics.evaluate``.

    Args:
        cache: the split.
        config: of the networks.
        device: where they are.
    """

    def __init__(self, cache: Cache, config: NetworkConfig, device: torch.device) -> None:
        self._cache = cache
        self._batches = Batches(cache, device, config)
        self._rasters = [cache.raster(scene) for scene in range(len(cache.manifest.scenes))]

    def __call__(self, networks: CvaeNetworks) -> dict[str, float]:
        """The figures that need no samples, quick enough for after each epoch."""
        return self.judge(networks, samples=0, draws=0)

    @torch.no_grad()
    def judge(self, networks: CvaeNetworks, samples: int, draws: int) -> dict[str, float]:
        """All figures.

        Args:
            networks: in evaluation mode.
            samples: trajectories drawn for each pair; 0 leaves such figures out.
            draws: for calibration; 0 leaves it out.
        """
        network = networks.of(AgentType.VEHICLE)
        means = MetricMeans()
        for start in range(0, len(self._batches), BATCH):
            indices = torch.arange(start, min(start + BATCH, len(self._batches)))
            features, future = self._batches.batch(indices)
            log_weights, positions = network(features, Context.FULL, future.shape[1])
            mixture = TrajectoryMixture(log_weights, positions.mean, positions.covariance, features["origin"])
            truth = (future.double() + features["origin"][:, None]).cpu().numpy()
            rasters = [self._rasters[int(scene)] for scene in self._cache.scene[indices.numpy()]]
            seeds = indices.tolist() if samples or draws else None
            means.add(instance_metrics(mixture, truth, rasters, seeds, samples=samples, draws=draws))
        return {name: value for name, value in means.means().items() if np.isfinite(value)}
