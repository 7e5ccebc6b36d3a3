"""Messages of the contract, from what the track memory holds."""

import math
from collections.abc import Sequence

from cab.forecast.v1 import consistency_service_pb2 as pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from model.metrics.consistency import RANGES_M
from service.tracking.aggregates import CONVERGENCES, DISPERSIONS, ERRORS, Aggregates, ModelAggregate
from service.tracking.metrics import AGES_S, InstantMetrics
from service.tracking.model_references import ModelReferences
from service.tracking.quantile_sketch import Distribution
from service.tracking.store.base import SceneStatus, TrackStatus

AGENT_TRACKING = {
    TrackStatus.KEPT: pb.TRACKING_STATUS_OK,
    TrackStatus.NEW: pb.TRACKING_STATUS_NEW,
    TrackStatus.RESET: pb.TRACKING_STATUS_RESET,
    TrackStatus.RETYPED: pb.TRACKING_STATUS_OK,
}
"""Tracking status of an agent in the contract."""
SCENE_TRACKING = {
    SceneStatus.KEPT: pb.TRACKING_STATUS_OK,
    SceneStatus.NEW: pb.TRACKING_STATUS_NEW,
    SceneStatus.LOST: pb.TRACKING_STATUS_RESET,
}
"""Tracking status of a scene in the contract."""

_QUANTILES = (0.5, 0.9, 0.99)


def instant_messages(
    metrics: InstantMetrics, agent_ids: Sequence[str], models: Sequence[str], references: ModelReferences
) -> list[pb.InstantConsistency]:
    """Return one message per instant.

    Args:
        metrics: metrics of P instants.
        agent_ids: [P], the observed agents.
        models: [P], the models that made the forecasts.
        references: references to models.
    """
    errors, nearest = metrics.errors_m.tolist(), metrics.nearest.tolist()
    convergence = metrics.convergence_s.tolist()
    dispersion = [values.tolist() for values in metrics.dispersion[:3]]
    columns = (metrics.time, metrics.complete, metrics.settled)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    messages = []
    for row, (time, complete, settled) in enumerate(rows):
        message = pb.InstantConsistency(
            agent_id=agent_ids[row],
            time=time,
            model=references.get(models[row]),
            complete=complete,
            settled=settled,
            errors=[
                pb.AgeError(
                    age=age, displacement_error=error, most_likely_was_nearest=most_likely_was_nearest
                )
                for age, error, most_likely_was_nearest in zip(
                    AGES_S.tolist(), errors[row], nearest[row], strict=True
                )
                if not math.isnan(error)
            ],
        )
        if complete:
            std, mean, rms = (values[row] for values in dispersion)
            message.dispersion.standard_deviation = std
            message.dispersion.mean = mean
            message.dispersion.root_mean_square = rms
            message.convergence.extend(
                pb.Convergence(range=range_m, duration=duration)
                for range_m, duration in zip(RANGES_M, convergence[row], strict=True)
            )
        messages.append(message)
    return messages


def model_messages(aggregates: Aggregates, references: ModelReferences) -> list[pb.ModelConsistency]:
    """Return one message per model with a settled set, by name and version."""
    return [
        _model_message(aggregates.models[name], references.get(name))
        for name in sorted(aggregates.models)
        if aggregates.models[name].instants
    ]


def _model_message(aggregate: ModelAggregate, reference: models_pb.ModelReference) -> pb.ModelConsistency:
    summaries = [_summary(aggregate.summarize(metric, _QUANTILES)) for metric in range(ERRORS.stop)]
    std, mean, rms = (summaries[metric] for metric in DISPERSIONS)
    return pb.ModelConsistency(
        model=reference,
        instants=aggregate.instants,
        dispersion_standard_deviation=std,
        dispersion_mean=mean,
        dispersion_root_mean_square=rms,
        convergence=[
            pb.ConvergenceSummary(range=range_m, duration=summaries[metric])
            for range_m, metric in zip(RANGES_M, CONVERGENCES, strict=True)
        ],
        errors=[
            pb.AgeSummary(
                age=age,
                displacement_error=summaries[metric],
                most_likely_was_nearest=aggregate.nearest_share(index),
            )
            for index, (age, metric) in enumerate(zip(AGES_S.tolist(), ERRORS, strict=True))
        ],
    )


def _summary(distribution: Distribution) -> pb.Summary:
    median, quantile_90, quantile_99 = distribution.quantiles.tolist()
    return pb.Summary(
        count=distribution.count,
        mean=distribution.mean,
        median=median,
        quantile_90=quantile_90,
        quantile_99=quantile_99,
    )
