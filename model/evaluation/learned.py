"""Checkpoints on the pairs of a cache."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from model.data.cache_builder import open_cache
from model.data.cache_layout import CacheKey, in_agent_frame
from model.data.checks import FUTURE_STEPS
from model.data.scenes import Reader
from model.evaluation.ablation import Without, ablations
from model.evaluation.subjects import Learned
from model.forecaster import Protocol
from model.metrics.aggregate import MetricMeans
from model.networks.config import AnyNetworkConfig, NetworkConfig
from model.scenes.scene import AgentType
from model.training.validation import Validation


@dataclass(frozen=True)
class Judged:
    """Figures of one checkpoint."""

    metrics: MetricMeans = field(default_factory=MetricMeans)
    ablated: dict[Without, MetricMeans] = field(default_factory=dict)
    """By what was taken away from it; nothing that it does not look at."""


def judge_learned(
    validation: Validation,
    models: Sequence[Learned],
    ablate: bool,
    samples: int,
    draws: int,
    limit: int | None = None,
    tick: Callable[[int], None] = lambda done: None,
) -> dict[str, Judged]:
    """Figures of checkpoints on the pairs of one cache, some pairs at a time.

    Args:
        validation: of the cache, with all that it has.
        models: the checkpoints.
        ablate: whether to judge them with less context, too.
        samples: trajectories drawn for each pair; 0 leaves such figures out.
        draws: for calibration; 0 leaves it out.
        limit: how many of the first pairs; None: all.
        tick: told how many pairs are done.

    Returns:
        By ``key``.
    """
    judged = {model.info.full_name: Judged() for model in models}
    for batch in validation.batches(limit):
        for model in models:
            own = judged[model.info.full_name]
            mixture = model.forecaster.forecast(batch.features, AgentType.VEHICLE, steps=FUTURE_STEPS)
            own.metrics.add(batch.metrics(mixture, samples, draws))
            for without, take_away in ablations(model.info).items() if ablate else ():
                mixture = model.forecaster.forecast(
                    take_away(batch.features), AgentType.VEHICLE, steps=FUTURE_STEPS
                )
                means = own.ablated.setdefault(without, MetricMeans())
                means.add(batch.metrics(mixture, samples=0, draws=0))
        tick(batch.seeds[-1] + 1)
    return judged


def open_validations(
    models: Sequence[Learned],
    folder: Path,
    reader: Reader,
    kind: str,
    split: str,
    protocol: Protocol,
    said: Callable[[str], None],
) -> Iterator[tuple[Validation, list[Learned]]]:
    """The caches that the checkpoints need, each with those that share it; the other arguments are
    ``open_cache``'s.

    Raises:
        DataError: the data is bad.
    """
    shared: dict[CacheKey, tuple[AnyNetworkConfig, list[Learned]]] = {}
    for model in models:
        # What looks at no neighbours can share the cache of what does
        shares = not (model.config.neighbor_types or in_agent_frame(model.config))
        config = NetworkConfig() if shares else model.config
        made = CacheKey.of(reader, split, protocol, config, model.info.history_frames)
        shared.setdefault(made, (config, []))[1].append(model)
    for made, (config, group) in shared.items():
        cache = open_cache(folder, reader, kind, split, protocol, config, made.history_frames, said)
        yield Validation(cache, None, torch.device("cpu")), group
