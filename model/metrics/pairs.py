"""Challenge pairs with the ground truth that their forecasts are compared with.

Benchmark, evaluation and validation all compute the metrics of a pair here, whoever made the forecast.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from model.arrays import Bools, Floats, Ints
from model.metrics.evaluate import instance_metrics
from model.metrics.oracle import oracle_figures, oracle_mixture
from model.mixture import TrajectoryMixture
from model.scenes.scene import Raster

SEED_STRIDE: Final = 1_000_003
"""Distance between the random seeds of one pair under successive ``Sampling.seed``; more than any split has
pairs, so that no two pairs share a seed."""


@dataclass(frozen=True)
class Sampling:
    """Number of random draws for the metrics that need them."""

    samples: int
    """Trajectories drawn for each pair (ADE-f, FDE-f, OffR-f); 0 omits these metrics."""
    draws: int
    """Positions drawn at each step for calibration; 0 omits it."""
    seed: int = 0


@dataclass(frozen=True)
class EvaluatedPairs:
    """N challenge pairs: an agent and a frame each."""

    numbers: Ints
    """[N], index of each pair in the split. It seeds what is drawn for the pair, so that figures do not
    depend on batching."""
    truth: Floats
    """[N, 12, 2], m, ground frame."""
    rasters: Sequence[Raster]
    """N maps; pairs of one scene share theirs."""
    stood: Bools
    """[N], whether the agent stood before now (``model.metrics.standing``)."""

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, rows: Ints) -> "EvaluatedPairs":
        """Return the pairs of some rows."""
        return EvaluatedPairs(
            self.numbers[rows], self.truth[rows], [self.rasters[row] for row in rows], self.stood[rows]
        )

    def metrics(self, mixture: TrajectoryMixture, sampling: Sampling) -> dict[str, Floats]:
        """Return ``instance_metrics`` of forecasts of these pairs, [N] each.

        Args:
            mixture: the forecasts.
            sampling: number of random draws.
        """
        return instance_metrics(
            mixture,
            self.truth,
            self.rasters,
            (self.numbers + sampling.seed * SEED_STRIDE).tolist(),
            samples=sampling.samples,
            draws=sampling.draws,
            stood=self.stood,
        )

    def oracle_metrics(self, physics: Mapping[str, TrajectoryMixture]) -> dict[str, Floats]:
        """Return the metrics of the physics oracle on these pairs, [N] each.

        Args:
            physics: forecasts by the names of the models; the four physics baselines are among them.
        """
        best = oracle_mixture(physics, self.truth)
        return oracle_figures(instance_metrics(best, self.truth, self.rasters, stood=self.stood))
