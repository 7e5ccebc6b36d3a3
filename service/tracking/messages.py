"""Figures into the contract's messages."""

import math
from collections.abc import Sequence

from cab.forecast.v1 import consistency_service_pb2 as pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from model.metrics.convergence import RANGES_M
from service.tracking.aggregates import CONVERGENCES, DISPERSIONS, ERRORS, ModelSums, Sums
from service.tracking.metrics import AGES_S, Figures
from service.tracking.model_references import ModelReferences
from service.tracking.quantile_sketch import Spread

_QUANTILES = (0.5, 0.9, 0.99)


def instant_messages(
    figures: Figures, agent_ids: Sequence[str], series: Sequence[str], references: ModelReferences
) -> list[pb.InstantConsistency]:
    """P messages.

    Args:
        figures: of P instants.
        agent_ids: P, whose observations.
        series: P, whose forecasts.
        references: references to models.
    """
    errors, nearest = figures.errors_m.tolist(), figures.nearest.tolist()
    convergence = figures.convergence_s.tolist()
    apart = [values.tolist() for values in figures.dispersion[:3]]
    columns = (figures.time, figures.complete, figures.settled)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    messages = []
    for row, (time, complete, settled) in enumerate(rows):
        message = pb.InstantConsistency(
            agent_id=agent_ids[row],
            time=time,
            model=references.get(series[row]),
            complete=complete,
            settled=settled,
            errors=[
                pb.AgeError(age=age, displacement_error=error, most_likely_was_nearest=right)
                for age, error, right in zip(AGES_S.tolist(), errors[row], nearest[row], strict=True)
                if not math.isnan(error)
            ],
        )
        if complete:
            std, mean, rms = (values[row] for values in apart)
            message.dispersion.standard_deviation = std
            message.dispersion.mean = mean
            message.dispersion.root_mean_square = rms
            message.convergence.extend(
                pb.Convergence(range=range_m, duration=duration)
                for range_m, duration in zip(RANGES_M, convergence[row], strict=True)
            )
        messages.append(message)
    return messages


def model_messages(sums: Sums, references: ModelReferences) -> list[pb.ModelConsistency]:
    """One message a model that has a settled set, by name and version."""
    return [
        _model_message(sums.models[name], references.get(name))
        for name in sorted(sums.models)
        if sums.models[name].instants
    ]


def _model_message(sums: ModelSums, reference: models_pb.ModelReference) -> pb.ModelConsistency:
    summaries = [_summary(sums.spread(figure, _QUANTILES)) for figure in range(ERRORS.stop)]
    std, mean, rms = (summaries[figure] for figure in DISPERSIONS)
    return pb.ModelConsistency(
        model=reference,
        instants=sums.instants,
        dispersion_standard_deviation=std,
        dispersion_mean=mean,
        dispersion_root_mean_square=rms,
        convergence=[
            pb.ConvergenceSummary(range=range_m, duration=summaries[figure])
            for range_m, figure in zip(RANGES_M, CONVERGENCES, strict=True)
        ],
        errors=[
            pb.AgeSummary(
                age=age,
                displacement_error=summaries[figure],
                most_likely_was_nearest=sums.nearest(number),
            )
            for number, (age, figure) in enumerate(zip(AGES_S.tolist(), ERRORS, strict=True))
        ],
    )


def _summary(spread: Spread) -> pb.Summary:
    median, high, highest = spread.quantiles.tolist()
    return pb.Summary(
        count=spread.count, mean=spread.mean, median=median, quantile_90=high, quantile_99=highest
    )
