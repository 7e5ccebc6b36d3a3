"""Evaluation of networks on the pairs of a split."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from model.data.batches import Batches
from model.data.cache import Cache
from model.forecaster import Context, Features
from model.metrics.aggregate import MetricMeans
from model.metrics.pairs import EvaluatedPairs, Sampling
from model.metrics.standing import stood
from model.networks.config import AnyNetworkConfig
from model.networks.forecaster import Networks, network_mixture
from model.scenes.scene import AgentType

BATCH = 512


@dataclass(frozen=True)
class EvaluationBatch:
    """N pairs with the inputs of a network."""

    features: Features
    """Features with full context, on the device."""
    pairs: EvaluatedPairs


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
            mixture = network_mixture(network, batch.features, Context.FULL, batch.pairs.truth.shape[1])
            means.add(batch.pairs.metrics(mixture, Sampling(samples, draws)))
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
            numbers = indices.numpy()
            yield EvaluationBatch(
                features,
                EvaluatedPairs(numbers, truth, [rasters[scene] for scene in scenes], self._stood[numbers]),
            )
