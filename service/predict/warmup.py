"""Warm-up: the first forwards of each model, which allocate, compile and cache, before any call waits."""

import math
import time
from collections.abc import Container

import numpy as np
import structlog
import torch

from model.forecaster import Context, Features, Forecaster, Prepared, agent_count, join
from model.scenes.scene import AgentType
from service.predict.batcher import Batcher, Job
from service.predict.canary import straight_scene
from service.predict.catalog import Catalog

_log = structlog.get_logger(__name__)

_SCENE_AGENTS = 8
_SPEED = 5.0


async def warm_up(
    batcher: Batcher,
    catalog: Catalog,
    max_batch_agents: int,
    warm: Container[int] = (),
    max_seconds: float = math.inf,
) -> None:
    """Run every model once per agent type; the default and the fallback also in larger batches.

    Batch sizes are the powers of two and the largest. Most calls use the default model, and large batches of
    all models would delay readiness by seconds.

    Args:
        batcher: the batcher, whose model thread runs the forwards.
        catalog: the models.
        max_batch_agents: the max size of a batch.
        warm: ``id`` of the models that are warm already.
        max_seconds: duration of a forward beyond which no larger batch of the model is run, so that calls in
            progress never wait for long.
    """
    started = time.perf_counter()
    forwards = 0
    for info in catalog.models.infos():
        forecaster = catalog.get(info.full_name)
        if id(forecaster) in warm:
            continue
        main = forecaster is catalog.default or forecaster is catalog.fallback
        sizes = _sizes(max_batch_agents) if main else [1]
        for kind in info.agent_types:
            for context in info.contexts:
                for job in await batcher.call_in_model_thread(_jobs, forecaster, kind, context, sizes):
                    seconds = await batcher.run_in_model_threads(job)
                    forwards += 1
                    if seconds > max_seconds:
                        break
    _log.info("warmed up", forwards=forwards, seconds=round(time.perf_counter() - started, 3))


def _sizes(largest: int) -> list[int]:
    """Return 1, 2, 4, … and the largest."""
    sizes = [1 << power for power in range(largest.bit_length()) if 1 << power < largest]
    return [*sizes, largest]


def _jobs(forecaster: Forecaster, kind: AgentType, context: Context, sizes: list[int]) -> list[Job]:
    """Return one job per size."""
    with torch.inference_mode():
        scene = straight_scene(kind, forecaster.info.history_frames, [_SPEED] * _SCENE_AGENTS)
        few = forecaster.prepare(scene, np.arange(_SCENE_AGENTS), context)
        steps = forecaster.info.steps
        return [Job(forecaster, kind, context, Prepared(_repeat(few, size)), steps) for size in sizes]


def _repeat(features: Features, size: int) -> Features:
    """Return features of ``size`` agents, repeated from those of a few."""
    copies = -(-size // agent_count(features))
    return {name: tensor[:size] for name, tensor in join([features] * copies).items()}
