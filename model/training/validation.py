"""Evaluation of networks on the pairs of a split."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from model.arrays import Bools, Floats
from model.data.batches import Batches
from model.data.cache import Cache
from model.forecaster import Context, Features
from model.metrics.aggregate import MetricMeans
from model.metrics.evaluate import instance_metrics
from model.metrics.standing import stood
from model.mixture import TrajectoryMixture
from model.networks.config import AnyNetworkConfig
from model.networks.forecaster import Networks, network_mixture
from model.scenes.scene import AgentType, Raster

BATCH = 512


@dataclass(frozen=True)
class EvaluationBatch:
    """N pairs, and what their forecasts are evaluated against."""

    features: Features
    """Features with full context, on the device."""
    truth: Floats
    """[N, 12, 2], m, ground frame."""
    rasters: Sequence[Raster]
    """N rasters; pairs of a scene share one."""
    stood: Bools
    """[N], whether the agents stood before now (``model.metrics.standing``)."""
    seeds: Sequence[int]
    """N numbers of the pairs in the split, so that samples of a pair do not depend on its batch."""

    def metrics(self, mixture: TrajectoryMixture, samples: int, draws: int) -> dict[str, Floats]:
        """Return ``instance_metrics`` of forecasts of these pairs.

        Args:
            mixture: the forecasts.
            samples: trajectories drawn for each pair; 0: no sampled figures.
            draws: positions drawn for calibration; 0: no calibration.
        """
        seeds = self.seeds if samples or draws else None
        return instance_metrics(
            mixture, self.truth, self.rasters, seeds, samples=samples, draws=draws, stood=self.stood
        )


class Validation:
    """A split on which networks are evaluated, by the metrics of ``model.metrics.evaluate``.

    Args:
        cache: cache of the split.
        config: configuration of the networks; None: all features of the cache.
        device: device of the networks.
    """

    def __init__(self, cache: Cache, config: AnyNetworkConfig | None, device: torch.device) -> None:
        self._cache = cache
        self._batches = Batches(cache, device, config)
        self._stood = stood(cache.observed_positions())

    def __call__(self, networks: Networks[Any]) -> dict[str, float]:
        """Return the figures that need no samples; they are quick enough for each epoch."""
        return self.evaluate(networks, samples=0, draws=0)

    @property
    def pairs(self) -> Batches:
        """The pairs of the split."""
        return self._batches

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self._batches)

    @torch.no_grad()
    def evaluate(self, networks: Networks[Any], samples: int, draws: int) -> dict[str, float]:
        """Return all figures by name.

        Args:
            networks: networks in evaluation mode.
            samples: trajectories drawn for each pair; 0: no sampled figures.
            draws: positions drawn for calibration; 0: no calibration.
        """
        network = networks.of(AgentType.VEHICLE)
        means = MetricMeans()
        for batch in self.batches():
            mixture = network_mixture(network, batch.features, Context.FULL, batch.truth.shape[1])
            means.add(batch.metrics(mixture, samples, draws))
        return {name: value for name, value in means.figures().items() if np.isfinite(value)}

    def batches(self, limit: int | None = None) -> Iterator[EvaluationBatch]:
        """Yield the pairs in order, a batch at a time; only the batch's maps are in memory.

        Args:
            limit: number of pairs, from the first on; None: all.
        """
        count = len(self) if limit is None else min(limit, len(self))
        for start in range(0, count, BATCH):
            indices = torch.arange(start, min(start + BATCH, count))
            features, future = self._batches.batch(indices)
            truth = (future.double() + features["origin"][:, None]).cpu().numpy()
            scenes = self._cache.scene[indices.numpy()].tolist()
            rasters = {scene: self._cache.raster(scene) for scene in set(scenes)}
            yield EvaluationBatch(
                features,
                truth,
                [rasters[scene] for scene in scenes],
                self._stood[indices.numpy()],
                indices.tolist(),
            )
