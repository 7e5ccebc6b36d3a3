"""Messages of the contract, from what the track memory holds."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from cab.forecast.v1 import consistency_service_pb2 as pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from model.metrics.consistency import RANGES_M
from service.tracking.aggregates import CONVERGENCES, DISPERSIONS, ERRORS, Aggregates, ModelAggregate
from service.tracking.metrics import AGES_S, InstantMetrics, instant_metrics
from service.tracking.model_references import ModelReferences
from service.tracking.quantile_sketch import Distribution
from service.tracking.store.base import Instants, SceneStatus, TrackStatus

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
_DECIMALS = 3
"""Decimals of distances in documents, which are for the eye."""


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


def model_document(model: models_pb.ModelReference) -> dict[str, Any]:
    """Return a reference to a model in the contract's JSON mapping."""
    protocol = models_pb.InputProtocol.Name(model.protocol)
    return {"name": model.name, "version": model.version, "protocol": protocol}


def latest_documents(
    requested: Mapping[str, str], instants: Instants, references: ModelReferences
) -> dict[str, dict[str, Any]]:
    """Return the consistency at each agent's newest observation by agent id, in the contract's JSON mapping.

    Args:
        requested: the model of each agent, ``name@version`` by agent id.
        instants: what an exchange with the track memory returned.
        references: references to models.
    """
    if not instants.models:
        return {}
    newest: dict[str, int] = {}
    metrics = instant_metrics(instants.packed)
    times = metrics.time.tolist()
    for row, (agent_id, model) in enumerate(zip(instants.agent_ids, instants.models, strict=True)):
        known = newest.get(agent_id)
        if requested.get(agent_id) == model and (known is None or times[row] > times[known]):
            newest[agent_id] = row
    chosen = metrics.rows(list(newest.values()))
    models = {name: model_document(references.get(name)) for name in set(requested.values())}
    errors, nearest = chosen.errors_m.round(_DECIMALS).tolist(), chosen.nearest.tolist()
    convergence = chosen.convergence_s.tolist()
    dispersion = [values.round(_DECIMALS).tolist() for values in chosen.dispersion[:3]]
    ages = AGES_S.tolist()
    documents: dict[str, dict[str, Any]] = {}
    flags = zip(chosen.time.tolist(), chosen.complete.tolist(), chosen.settled.tolist(), strict=True)
    for row, (agent_id, (time, complete, settled)) in enumerate(zip(newest, flags, strict=True)):
        documents[agent_id] = document = {
            "agent_id": agent_id,
            "time": time,
            "model": models[requested[agent_id]],
            "complete": complete,
            "settled": settled,
            "convergence": [],
            "errors": [
                {"age": age, "displacement_error": error, "most_likely_was_nearest": was_nearest}
                for age, error, was_nearest in zip(ages, errors[row], nearest[row], strict=True)
                if error == error  # noqa: PLR0124 - not NaN: there is a forecast of that age
            ],
        }
        if complete:
            names = ("standard_deviation", "mean", "root_mean_square")
            document["dispersion"] = dict(zip(names, (each[row] for each in dispersion), strict=True))
            document["convergence"] = [
                {"range": range_m, "duration": duration}
                for range_m, duration in zip(RANGES_M, convergence[row], strict=True)
            ]
    return documents


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
