"""Encoding of a plan's forecasts as the contract's response."""

import hashlib
from collections import Counter
from collections.abc import Sequence

import numpy as np
import torch

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Floats, Ints
from model.metrics.offroad import off_road
from model.mixture import TrajectoryMixture
from model.scenes.scene import STEP_SECONDS, Raster
from service.predict.batcher import seconds_in_model
from service.predict.catalog import reference
from service.predict.plan import Group, Plan
from service.predict.request import Options
from service.predict.wire import packed_doubles, packed_tag

_WEIGHTS, _MEANS, _COVARIANCES, _SAMPLES = (
    packed_tag(pb.AgentForecast.DESCRIPTOR, name) for name in ("weights", "means", "covariances", "samples")
)
TRIANGLE = ((0, 0), (0, 1), (1, 1))
"""Elements of a covariance that are sent."""


def encode(plan: Plan, seed: int) -> pb.PredictResponse:
    """Return the response to a call.

    Args:
        plan: the plan of the call, whose groups have run.
        seed: the seed of the samples; 0 if none are drawn.
    """
    response = pb.PredictResponse(
        model=reference(plan.forecaster.info),
        time=plan.options.time,
        steps=plan.options.steps,
        step=STEP_SECONDS,
        seed=seed,
        warnings=plan.warnings,
    )
    outcomes = [group.outcome for group in plan.groups if group.outcome is not None]
    response.timing.queue = min((outcome.queue for outcome in outcomes), default=0.0)
    response.timing.inference = seconds_in_model(outcomes)
    response.timing.batch_agents = max((outcome.batch_agents for outcome in outcomes), default=0)

    forecasts: dict[int, pb.AgentForecast] = {}
    for draft in plan.drafts:
        forecast = response.forecasts.add(agent_id=draft.agent_id, status=draft.status, detail=draft.detail)
        if draft.status == pb.FORECAST_STATUS_INVALID:
            forecast.field = draft.field
        forecast.warnings.extend(plan.input_warnings.get(draft.index, ()))
        if draft.forecaster is not None:
            forecast.model.CopyFrom(reference(draft.forecaster.info))
            forecast.history_frames = draft.history_frames
            forecasts[draft.index] = forecast
    for group in plan.groups:
        if group.outcome is not None and group.drafts:
            members = [forecasts[draft.index] for draft in group.drafts]
            _fill(members, group, group.outcome.mixture, plan.options, seed)
    return response


def agent_seed(seed: int, agent_id: str) -> int:
    """Return the seed of one agent's samples, which does not depend on the other agents of call or batch.

    Args:
        seed: the seed of the call, 32 bits.
        agent_id: the id of the agent.
    """
    digest = hashlib.blake2b(agent_id.encode(), digest_size=8, key=seed.to_bytes(4, "little")).digest()
    return int.from_bytes(digest, "little") >> 1  # torch takes 63 bits without a sign


def count_off_road(raster: Raster | None, groups: Sequence[Group]) -> Counter[str]:
    """Count, by model, the most likely trajectories that leave the driveable area: known without any truth.

    Args:
        raster: the map of the scene; None: the road is unknown.
        groups: the forecasts.
    """
    counts: Counter[str] = Counter()
    if raster is None:
        return counts
    for group in groups:
        if group.outcome is None or not group.drafts:
            continue
        mixture = group.outcome.mixture
        # In numpy: torch would start helper threads here, which compete with the model
        rows = np.arange(len(mixture))
        paths = mixture.means.numpy()[rows, mixture.log_weights.numpy().argmax(axis=1)]
        leaving = off_road(raster, paths + mixture.origin.numpy()[:, None]) > 0
        if leaving.any():
            counts[group.job.forecaster.info.name] += int(leaving.sum())
    return counts


def _fill(
    forecasts: Sequence[pb.AgentForecast],
    group: Group,
    mixture: TrajectoryMixture,
    options: Options,
    seed: int,
) -> None:
    """Fill in the numbers of N agents' forecasts; at most M of the K modes each."""
    agents, modes = mixture.log_weights.shape
    counts: Ints = np.full(agents, modes)
    mode_ids: Ints = np.broadcast_to(np.arange(modes), (agents, modes))
    samples: Floats = np.zeros((agents, 0))
    with torch.inference_mode():
        if options.samples:
            seeds = [agent_seed(seed, forecast.agent_id) for forecast in forecasts]
            samples = mixture.sample(options.samples, seeds).numpy().reshape(agents, -1)
        if options.merge:
            merged = group.merged()
            mixture, counts, mode_ids = merged.mixture, merged.counts.numpy(), merged.mode_ids.numpy()
            modes = mode_ids.shape[1]
    weights = softmax(mixture.log_weights.numpy().astype(np.float64))
    means, covariances = mixture.means.numpy(), mixture.covariances.numpy()
    remaining = np.zeros(agents)
    if 0 < options.max_modes < modes:
        heaviest = np.argsort(-weights, axis=1, kind="stable")[:, : options.max_modes]
        places = np.sort(heaviest, axis=1)
        rows = np.arange(agents)[:, None]
        counts = np.minimum(counts, options.max_modes)
        weights, means, covariances, mode_ids = (
            weights[rows, places],
            means[rows, places],
            covariances[rows, places],
            mode_ids[rows, places],
        )
        remaining = np.clip(1.0 - weights.sum(axis=1), 0.0, 1.0)
    positions: Floats = means + mixture.origin.numpy()[:, None, None]
    triangles: Floats = np.empty((*covariances.shape[:-2], 3))
    for place, (row, column) in enumerate(TRIANGLE):
        triangles[..., place] = covariances[..., row, column]
    best, left, numbers = weights.argmax(axis=1).tolist(), remaining.tolist(), mode_ids.tolist()
    for row, (forecast, count) in enumerate(zip(forecasts, counts.tolist(), strict=True)):
        # Merged agents have padding behind their modes
        forecast.mode_ids.extend(numbers[row][:count])
        forecast.remaining_weight = left[row]
        forecast.most_likely_mode = best[row]
        forecast.MergeFromString(
            packed_doubles(_WEIGHTS, weights[row, :count])
            + packed_doubles(_MEANS, positions[row, :count])
            + packed_doubles(_COVARIANCES, triangles[row, :count])
            + packed_doubles(_SAMPLES, samples[row])
        )


def softmax(log_weights: Floats) -> Floats:
    """Return the probabilities [N, K] of log-weights [N, K]."""
    weights: Floats = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    return weights
