"""Physics, Kalman and the physics oracle on recorded scenes.

They forecast from the scene, as in the server: a cache of pairs does not hold what they need.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import Bools, Floats
from model.baselines import physics
from model.baselines.kalman import HISTORY_FRAMES
from model.data.checks import FUTURE_STEPS, STEPS_AHEAD, check_pairs
from model.data.protocols import SceneFrames
from model.data.scenes import DataError, Pair, Reader, SceneRecord
from model.forecaster import Features, Forecaster, Protocol, join
from model.metrics.aggregate import MetricMeans
from model.metrics.evaluate import instance_metrics
from model.metrics.oracle import ORACLE, oracle_figures, oracle_mixture
from model.scenes.scene import AgentType, Raster


@dataclass(frozen=True)
class ScenePairs:
    """N pairs of one scene."""

    features: Sequence[Features]
    """Of each forecaster."""
    truth: Floats
    """[N, 12, 2], m, ground frame."""
    raster: Raster
    stood: Bools
    """[N], whether the agent stood before now (``model.metrics.standing``)."""


def judge_baselines(
    reader: Reader,
    split: str,
    protocol: Protocol,
    baselines: Sequence[Forecaster],
    oracle: bool,
    samples: int,
    draws: int,
    limit: int | None = None,
    tick: Callable[[int], None] = lambda done: None,
) -> dict[str, MetricMeans]:
    """Figures of baselines on the pairs of a split, one scene at a time.

    Args:
        reader: of the data.
        split: one of the reader's.
        protocol: of the inputs.
        baselines: what is judged.
        oracle: whether the physics oracle is, too.
        samples: trajectories drawn for each pair; 0 leaves such figures out.
        draws: for calibration; 0 leaves it out.
        limit: how many of the first pairs; None: all.
        tick: told how many pairs are done.

    Returns:
        By ``key``; the oracle under its name.

    Raises:
        DataError: the data is bad, or the split has no pairs.
    """
    rows = [one.info.full_name for one in baselines] + [ORACLE] * oracle
    means = {row: MetricMeans() for row in rows}
    forecasters = {one.info.name: one for one in (*(physics.baselines() if oracle else ()), *baselines)}
    done = 0
    for pairs in scene_pairs(reader, split, protocol, list(forecasters.values()), limit):
        count = len(pairs.truth)
        mixtures = {
            name: forecaster.forecast(features, AgentType.VEHICLE, steps=FUTURE_STEPS)
            for (name, forecaster), features in zip(forecasters.items(), pairs.features, strict=True)
        }
        rasters, seeds = [pairs.raster] * count, range(done, done + count)
        for one in baselines:
            metrics = instance_metrics(
                mixtures[one.info.name],
                pairs.truth,
                rasters,
                seeds,
                samples=samples,
                draws=draws,
                stood=pairs.stood,
            )
            means[one.info.full_name].add(metrics)
        if oracle:
            best = oracle_mixture(mixtures, pairs.truth)
            metrics = instance_metrics(best, pairs.truth, rasters, stood=pairs.stood)
            means[ORACLE].add(oracle_figures(metrics))
        done += count
        tick(done)
    if not done:
        raise DataError(f"the split {split!r} has no pairs")
    return means


def scene_pairs(
    reader: Reader,
    split: str,
    protocol: Protocol,
    forecasters: Sequence[Forecaster],
    limit: int | None = None,
) -> Iterator[ScenePairs]:
    """The pairs of a split in the order of a cache's, a scene at a time; arguments as ``judge_baselines``."""
    left = limit
    for record in reader.scenes(split):
        check_pairs(record.name, record.tracks, record.pairs)
        pairs = record.pairs if left is None else record.pairs[:left]
        yield _scene(record, pairs, protocol, forecasters)
        if left is not None:
            left -= len(pairs)
            if not left:
                return


def _scene(
    record: SceneRecord, pairs: Sequence[Pair], protocol: Protocol, forecasters: Sequence[Forecaster]
) -> ScenePairs:
    frames = SceneFrames(record, protocol, HISTORY_FRAMES)
    parts: list[list[Features]] = [[] for _ in forecasters]
    for frame in sorted({pair.frame for pair in pairs}):  # the pairs are in this order
        scene, tracks = frames.at(frame)
        targets = np.searchsorted(tracks, [pair.track for pair in pairs if pair.frame == frame])
        for forecaster, part in zip(forecasters, parts, strict=True):
            part.append(forecaster.prepare(scene, targets))
    truth = np.stack([record.tracks[pair.track].positions(pair.frame + STEPS_AHEAD) for pair in pairs])
    return ScenePairs([join(part) for part in parts], truth, record.raster, record.stood(pairs))
