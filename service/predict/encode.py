"""Mixtures into the contract's messages."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Bools, Floats, Ints
from model.mixture import TrajectoryMixture, merge_modes
from model.scenes.scene import STEP_SECONDS
from service.predict.batcher import Outcome
from service.predict.catalog import reference
from service.predict.plan import Draft, Plan
from service.predict.request import Options


@dataclass(frozen=True)
class Result:
    """Forecasts that were made, and for whom."""

    drafts: Sequence[Draft]
    mixture: TrajectoryMixture
    """Of those drafts, in order; every number finite."""


@dataclass(frozen=True)
class _Numbers:
    """A result's numbers as the answer wants them, float64; at most M of the K modes."""

    counts: Ints
    """[N], how many of the M are the agent's; what stands behind them is to be left out."""
    mode_ids: Ints
    """[N, M], ascending."""
    weights: Floats
    """[N, M]."""
    remaining: Floats
    """[N]."""
    means: Floats
    """[N, M, T · 2]."""
    covariances: Floats
    """[N, M, T · 3]."""
    samples: Floats
    """[N, S · T · 2]."""


def finite(mixture: TrajectoryMixture) -> Bools:
    """[N], whether an agent's forecast can be sent."""
    weights = mixture.log_weights.double().exp()
    parts = [
        torch.isfinite(weights).all(dim=1) & (weights.sum(dim=1) > 0),
        torch.isfinite(mixture.means).flatten(1).all(dim=1),
        torch.isfinite(mixture.covariances).flatten(1).all(dim=1),
        torch.isfinite(mixture.origin).all(dim=1),
    ]
    mask: Bools = torch.stack(parts).all(dim=0).numpy()
    return mask


def agent_seed(seed: int, agent_id: str) -> int:
    """Seed of one agent's samples: the same whoever else is in the call or the batch.

    Args:
        seed: the call's, 32 bits.
        agent_id: the agent's.
    """
    digest = hashlib.blake2b(agent_id.encode(), digest_size=8, key=seed.to_bytes(4, "little")).digest()
    return int.from_bytes(digest, "little") >> 1  # torch takes 63 bits without a sign


def encode(
    plan: Plan, results: Sequence[Result], outcomes: Sequence[Outcome], seed: int
) -> pb.PredictResponse:
    """The answer to a call.

    Args:
        plan: what was to be answered.
        results: the forecasts that were made.
        outcomes: of all batches that the call rode in.
        seed: of the samples; 0 when none are drawn.
    """
    options = plan.options
    response = pb.PredictResponse(
        model=reference(plan.forecaster.info),
        time=options.time,
        steps=options.steps,
        step=STEP_SECONDS,
        seed=seed,
        warnings=plan.warnings,
    )
    response.timing.queue = min((outcome.queue for outcome in outcomes), default=0.0)
    response.timing.inference = sum(outcome.inference for outcome in outcomes)
    response.timing.batch_agents = max((outcome.batch_agents for outcome in outcomes), default=0)

    places: dict[int, tuple[_Numbers, int]] = {}
    for result in results:
        seeds = [agent_seed(seed, draft.agent_id) for draft in result.drafts]
        numbers = _numbers(result.mixture, options, seeds)
        for row, draft in enumerate(result.drafts):
            places[draft.index] = numbers, row
    for draft in plan.drafts:
        forecast = response.forecasts.add(agent_id=draft.agent_id, status=draft.status, detail=draft.detail)
        if draft.status == pb.FORECAST_STATUS_INVALID:
            forecast.field = draft.field
        if draft.forecaster is not None:
            forecast.model.CopyFrom(reference(draft.forecaster.info))
            forecast.history_frames = draft.history_frames
            _fill(forecast, *places[draft.index])
    return response


def _numbers(mixture: TrajectoryMixture, options: Options, seeds: Sequence[int]) -> _Numbers:
    agents, modes = mixture.log_weights.shape
    counts: Ints = np.full(agents, modes)
    mode_ids: Ints = np.broadcast_to(np.arange(modes), (agents, modes))
    with torch.inference_mode():
        drawn: Floats = (
            mixture.sample(options.samples, seeds).numpy() if options.samples else np.zeros((agents, 0))
        )
        if options.merge:
            merged = merge_modes(mixture)
            mixture, counts, mode_ids = merged.mixture, merged.counts.numpy(), merged.mode_ids.numpy()
            modes = mode_ids.shape[1]
        weights: Floats = mixture.log_weights.double().softmax(dim=1).numpy()
        means: Floats = mixture.world_means.numpy()
        covariances: Floats = mixture.covariances.double().numpy()
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
    triangle = covariances[..., [0, 0, 1], [0, 1, 1]]
    return _Numbers(
        counts=counts,
        mode_ids=mode_ids,
        weights=weights,
        remaining=remaining,
        means=means.reshape(*mode_ids.shape, -1),
        covariances=triangle.reshape(*mode_ids.shape, -1),
        samples=drawn.reshape(agents, -1),
    )


def _fill(forecast: pb.AgentForecast, numbers: _Numbers, row: int) -> None:
    # Lists, because protobuf takes a list of floats several times faster than an array
    count = int(numbers.counts[row])
    forecast.mode_ids.extend(numbers.mode_ids[row, :count].tolist())
    forecast.weights.extend(numbers.weights[row, :count].tolist())
    forecast.remaining_weight = float(numbers.remaining[row])
    forecast.most_likely_mode = int(numbers.weights[row, :count].argmax())
    forecast.means.extend(numbers.means[row, :count].ravel().tolist())
    forecast.covariances.extend(numbers.covariances[row, :count].ravel().tolist())
    forecast.samples.extend(numbers.samples[row].tolist())
