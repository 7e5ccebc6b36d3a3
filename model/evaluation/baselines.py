"""Physics, Kalman and the physics oracle on recorded scenes.

They forecast from the scene, as in the server: a cache of pairs does not hold what they need.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from model import physics
from model.arrays import Floats
from model.data.checks import FUTURE_STEPS, check_pairs
from model.data.protocols import SceneFrames
from model.data.scenes import DataError, Pair, Reader, SceneRecord
from model.evaluation.subjects import ORACLE, key
from model.forecaster import Features, Forecaster, Protocol, join
from model.kalman import HISTORY_FRAMES
from model.metrics.aggregate import MetricMeans
from model.metrics.evaluate import instance_metrics
from model.metrics.oracle import PHYSICS, physics_oracle
from model.mixture import TrajectoryMixture
from model.scene import AgentType, Raster

_OF_THE_LIKELIEST = ("ade_ml_", "fde_ml_", "off_road_ml")
"""The oracle's figures: it states one trajectory, and no density that could be judged."""


@dataclass(frozen=True)
class ScenePairs:
    """N pairs of one scene."""

    features: Sequence[Features]
    """Of each forecaster."""
    truth: Floats
    """[N, 12, 2], m, ground frame."""
    raster: Raster


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
    rows = [key(one.info) for one in baselines] + [ORACLE] * oracle
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
                mixtures[one.info.name], pairs.truth, rasters, seeds, samples=samples, draws=draws
            )
            means[key(one.info)].add(metrics)
        if oracle:
            best = oracle_forecast(mixtures, pairs.truth)
            metrics = instance_metrics(best, pairs.truth, rasters)
            means[ORACLE].add({n: v for n, v in metrics.items() if n.startswith(_OF_THE_LIKELIEST)})
        done += count
        tick(done)
    if not done:
        raise DataError(f"the split {split!r} has no pairs")
    return means


def oracle_forecast(mixtures: Mapping[str, TrajectoryMixture], truth: Floats) -> TrajectoryMixture:
    """Of the four physics forecasts of each pair, the one nearest to the truth on the mean.

    Args:
        mixtures: by the models' names, of N pairs, one mode; others than physics are left aside.
        truth: [N, T, 2], m, ground frame, finite.
    """
    four = [mixtures[name] for name in PHYSICS]
    trajectories = np.stack([one.most_likely_trajectory().numpy() for one in four], axis=1)
    choice = torch.from_numpy(physics_oracle(trajectories, truth).choice)
    rows = torch.arange(len(truth))
    return TrajectoryMixture(
        *(
            torch.stack([getattr(one, name) for one in four])[choice, rows]
            for name in ("log_weights", "means", "covariances", "origin")
        )
    )


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
    truth = np.stack([_future(record, pair) for pair in pairs])
    return ScenePairs([join(part) for part in parts], truth, record.raster)


def _future(record: SceneRecord, pair: Pair) -> Floats:
    """[12, 2], m, ground frame."""
    track = record.tracks[pair.track]
    start = int(np.searchsorted(track.frames, pair.frame)) + 1
    return track.position[start : start + FUTURE_STEPS]
