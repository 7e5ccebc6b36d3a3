"""Forecasts of recorded pairs in this process, and their metrics.

Checkpoints forecast from the features of a cache. Physics, Kalman and the physics oracle forecast from the
scene, as in the server: a cache does not hold what they need.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from model.baselines import physics
from model.baselines.kalman import HISTORY_FRAMES
from model.data.cache_builder import open_cache
from model.data.cache_layout import CacheKey, in_agent_frame
from model.data.checks import FUTURE_STEPS
from model.data.protocols import SceneFrames
from model.data.scenes import Reader
from model.evaluation.ablation import Without, ablations
from model.evaluation.pairs import ScenePairs, split_pairs
from model.evaluation.selection import Learned
from model.forecaster import Features, Forecaster, Protocol, join
from model.metrics.aggregate import MetricMeans
from model.metrics.oracle import ORACLE
from model.metrics.pairs import Sampling
from model.networks.config import AnyNetworkConfig, NetworkConfig
from model.scenes.scene import AgentType
from model.training.validation import Validation


@dataclass(frozen=True)
class ModelMeans:
    """Mean metrics of one model."""

    metrics: MetricMeans = field(default_factory=MetricMeans)
    ablated: dict[Without, MetricMeans] = field(default_factory=dict)
    """The same without a part of the context that the model uses."""


def evaluate_checkpoints(
    validation: Validation,
    models: Sequence[Learned],
    ablate: bool,
    sampling: Sampling,
    limit: int | None = None,
    tick: Callable[[int], None] = lambda done: None,
) -> dict[str, ModelMeans]:
    """Evaluate checkpoints on the pairs of one cache, batch by batch.

    Args:
        validation: the cache, with the features of every model.
        models: the checkpoints.
        ablate: whether to evaluate them with less context, too.
        sampling: number of random draws; none are made for ablations.
        limit: number of pairs, from the first; None: all.
        tick: called with the number of pairs done so far.

    Returns:
        Means by ``full_name``.
    """
    means = {model.info.full_name: ModelMeans() for model in models}
    for batch in validation.batches(limit):
        for model in models:
            own = means[model.info.full_name]
            mixture = model.forecaster.forecast(batch.features, AgentType.VEHICLE, steps=FUTURE_STEPS)
            own.metrics.add(batch.pairs.metrics(mixture, sampling))
            for without, take_away in ablations(model.info).items() if ablate else ():
                mixture = model.forecaster.forecast(
                    take_away(batch.features), AgentType.VEHICLE, steps=FUTURE_STEPS
                )
                ablated = own.ablated.setdefault(without, MetricMeans())
                ablated.add(batch.pairs.metrics(mixture, Sampling(samples=0, draws=0)))
        tick(int(batch.pairs.numbers[-1]) + 1)
    return means


def open_validations(
    models: Sequence[Learned],
    folder: Path,
    reader: Reader,
    kind: str,
    split: str,
    protocol: Protocol,
    log: Callable[[str], None],
) -> Iterator[tuple[Validation, list[Learned]]]:
    """Open the caches that checkpoints need, each with the checkpoints that share it.

    The other arguments are those of ``open_cache``.

    Raises:
        DataError: the data is invalid.
    """
    shared: dict[CacheKey, tuple[AnyNetworkConfig, list[Learned]]] = {}
    for model in models:
        # A network without neighbours can share the cache of one with neighbours
        shares = not (model.config.neighbor_types or in_agent_frame(model.config))
        config = NetworkConfig() if shares else model.config
        made = CacheKey.of(reader, split, protocol, config, model.info.history_frames)
        shared.setdefault(made, (config, []))[1].append(model)
    for made, (config, group) in shared.items():
        cache = open_cache(folder, reader, kind, split, protocol, config, made.history_frames, log)
        yield Validation(cache, None, torch.device("cpu")), group


def evaluate_baselines(
    reader: Reader,
    split: str,
    protocol: Protocol,
    baselines: Sequence[Forecaster],
    oracle: bool,
    sampling: Sampling,
    limit: int | None = None,
    tick: Callable[[int], None] = lambda done: None,
) -> dict[str, MetricMeans]:
    """Evaluate baselines on the pairs of a split, scene by scene.

    Args:
        reader: reader of the data.
        split: one of the reader's splits.
        protocol: protocol of the inputs.
        baselines: the baselines.
        oracle: whether to evaluate the physics oracle, too.
        sampling: number of random draws.
        limit: number of pairs, from the first; None: all.
        tick: called with the number of pairs done so far.

    Returns:
        Means by ``full_name``; those of the oracle by its name.

    Raises:
        DataError: the data is invalid, or the split has no pairs.
    """
    rows = [one.info.full_name for one in baselines] + [ORACLE] * oracle
    means = {row: MetricMeans() for row in rows}
    forecasters = {one.info.name: one for one in (*(physics.baselines() if oracle else ()), *baselines)}
    done = 0
    for scene in split_pairs(reader, split, limit):
        features = scene_features(scene, protocol, list(forecasters.values()))
        mixtures = {
            name: forecaster.forecast(part, AgentType.VEHICLE, steps=FUTURE_STEPS)
            for (name, forecaster), part in zip(forecasters.items(), features, strict=True)
        }
        pairs = scene.evaluated()
        for one in baselines:
            means[one.info.full_name].add(pairs.metrics(mixtures[one.info.name], sampling))
        if oracle:
            means[ORACLE].add(pairs.oracle_metrics(mixtures))
        done += len(pairs)
        tick(done)
    return means


def scene_features(
    scene: ScenePairs, protocol: Protocol, forecasters: Sequence[Forecaster]
) -> list[Features]:
    """Return the inputs of each forecaster for the pairs of a scene.

    Args:
        scene: N pairs.
        protocol: protocol of the inputs.
        forecasters: F forecasters that use at most ``HISTORY_FRAMES`` frames.

    Returns:
        [F], of N agents each.
    """
    frames = SceneFrames(scene.record, protocol, HISTORY_FRAMES)
    parts: list[list[Features]] = [[] for _ in forecasters]
    for frame in sorted({pair.frame for pair in scene.pairs}):  # pairs are ordered by frame
        observed, tracks = frames.at(frame)
        targets = np.searchsorted(tracks, [pair.track for pair in scene.pairs if pair.frame == frame])
        for forecaster, part in zip(forecasters, parts, strict=True):
            part.append(forecaster.prepare(observed, targets))
    return [join(part) for part in parts]
