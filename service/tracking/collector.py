"""Prometheus series of the track memory and of what it tells."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from model.arrays import Floats
from model.metrics.convergence import RANGES_M
from service.tracking.aggregates import CONVERGENCES, DISPERSIONS, ERRORS, ModelSums, Sums
from service.tracking.metrics import AGES_S

_STORE_SECONDS = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
_METERS = np.array([0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 50.0])
_CONVERGENCE_SECONDS = np.append(0.0, AGES_S)


class StoreMetrics:
    """Of the calls to the track memory.

    Args:
        registry: where they are shown.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        self._seconds = Histogram(
            "forecast_track_store_seconds",
            "Calls to the track memory, each to its own end.",
            ["op"],
            buckets=_STORE_SECONDS,
            registry=registry,
        )
        self._errors = Counter(
            "forecast_track_store_errors_total",
            "Calls to the track memory that got no answer in time, by what happened.",
            ["op", "reason"],
            registry=registry,
        )

    def observe(self, op: str, seconds: float) -> None:
        """A call ended."""
        self._seconds.labels(op).observe(seconds)

    def failed(self, op: str, reason: str) -> None:
        """None came in time."""
        self._errors.labels(op, reason).inc()


class ConsistencyCollector(Collector):
    """Shows ``Sums`` as histograms when they are asked for: to count each of the 18 figures of each agent in
    each call would take longer than to find them.

    Args:
        sums: gives those of the settled sets.
    """

    def __init__(self, sums: Callable[[], Sums]) -> None:
        self._sums = sums

    def collect(self) -> Iterable[Metric]:
        """The series, by model; versions of one name are added up."""
        apart = HistogramMetricFamily(
            "forecast_dispersion_meters",
            "Standard deviation of the distances to their barycentre of all ages' forecasts for one instant.",
            labels=["model"],
        )
        converged = HistogramMetricFamily(
            "forecast_convergence_seconds",
            "Since when all forecasts for an instant had been within tau meters of what was observed.",
            labels=["model", "tau"],
        )
        errors = HistogramMetricFamily(
            "forecast_displacement_error_meters",
            "Distance of the most likely forecast made horizon seconds ahead to what was observed.",
            labels=["model", "horizon"],
        )
        by_name: dict[str, list[ModelSums]] = {}
        for series, sums in self._sums().models.items():
            by_name.setdefault(series.partition("@")[0], []).append(sums)
        for name, parts in sorted(by_name.items()):
            _add(apart, [name], parts, DISPERSIONS[0], _METERS)
            for range_m, figure in zip(RANGES_M, CONVERGENCES, strict=True):
                _add(converged, [name, f"{range_m:g}"], parts, figure, _CONVERGENCE_SECONDS)
            for age, figure in zip(AGES_S.tolist(), ERRORS, strict=True):
                _add(errors, [name, f"{age:g}"], parts, figure, _METERS)
        return apart, converged, errors


def _add(
    family: HistogramMetricFamily,
    labels: Sequence[str],
    parts: Sequence[ModelSums],
    figure: int,
    bounds: Floats,
) -> None:
    counts = np.sum([part.up_to(figure, bounds) for part in parts], axis=0)
    buckets = [(f"{bound:g}", count) for bound, count in zip(bounds.tolist(), counts.tolist(), strict=True)]
    buckets.append(("+Inf", sum(part.instants for part in parts)))
    family.add_metric(labels, buckets=buckets, sum_value=sum(part.sum(figure) for part in parts))
