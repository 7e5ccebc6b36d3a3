"""Prometheus metrics of the track memory and of forecast consistency."""

from collections.abc import Iterable, Sequence

import numpy as np
from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from model.arrays import Floats
from model.metrics.consistency import RANGES_M
from service.tracking.aggregates import CONVERGENCES, DISPERSIONS, ERRORS, Aggregates, ModelAggregate
from service.tracking.metrics import AGES_S
from service.tracking.store.failures import FailureReason

_STORE_SECONDS = (0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
_STORE_OPS = ("ping", "exchange", "read", "reset", "publish", "raster_get", "raster_put", "raster_touch")
_METERS = np.array([0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 50.0])
_CONVERGENCE_SECONDS = np.append(0.0, AGES_S)


class StoreMetrics:
    """Metrics of the calls to the track memory.

    Args:
        registry: registry that exports them.
    """

    def __init__(self, registry: CollectorRegistry) -> None:
        self._seconds = Histogram(
            "forecast_track_store_seconds",
            "Duration of calls to the track memory, until they end.",
            ["op"],
            buckets=_STORE_SECONDS,
            registry=registry,
        )
        self._errors = Counter(
            "forecast_track_store_errors_total",
            "Calls to the track memory that failed or were late, by reason.",
            ["op", "reason"],
            registry=registry,
        )
        for op in _STORE_OPS:
            for reason in FailureReason:
                self._errors.labels(op, reason)

    def observe(self, op: str, seconds: float) -> None:
        """Record the duration of a call."""
        self._seconds.labels(op).observe(seconds)

    def failed(self, op: str, reason: str) -> None:
        """Count a call that failed or was late."""
        self._errors.labels(op, reason).inc()


class ConsistencyCollector(Collector):
    """Exports ``Aggregates`` as histograms.

    The histograms are computed at each scrape, from the aggregates as they are: adding the 18 metrics of each
    agent to Prometheus histograms in each call would take longer than computing them. A scrape changes
    nothing.

    Args:
        aggregates: aggregates of the settled sets.
        shadow: those of the shadow model; None: there is none.
    """

    def __init__(self, aggregates: Aggregates, shadow: Aggregates | None = None) -> None:
        self._aggregates = aggregates
        self._shadow = shadow

    def collect(self) -> Iterable[Metric]:
        """Return the metrics by model name; the versions of a model are added up, except the shadow's."""
        dispersion = HistogramMetricFamily(
            "forecast_dispersion_meters",
            "Standard deviation of the distances of all ages' forecasts for an instant to their barycentre.",
            labels=["model"],
        )
        convergence = HistogramMetricFamily(
            "forecast_convergence_seconds",
            "Seconds for which all forecasts for an instant had been within tau meters of the observation.",
            labels=["model", "tau"],
        )
        errors = HistogramMetricFamily(
            "forecast_displacement_error_meters",
            "Distance of the most likely forecast made horizon seconds ahead to the observed position.",
            labels=["model", "horizon"],
        )
        by_name: dict[str, list[ModelAggregate]] = {}
        for model, aggregate in self._aggregates.models.items():
            by_name.setdefault(model.partition("@")[0], []).append(aggregate)
        if self._shadow is not None:
            by_name |= {model: [aggregate] for model, aggregate in self._shadow.models.items()}
        for name, versions in sorted(by_name.items()):
            _add(dispersion, [name], versions, DISPERSIONS[0], _METERS)
            for range_m, metric in zip(RANGES_M, CONVERGENCES, strict=True):
                _add(convergence, [name, f"{range_m:g}"], versions, metric, _CONVERGENCE_SECONDS)
            for age, metric in zip(AGES_S.tolist(), ERRORS, strict=True):
                _add(errors, [name, f"{age:g}"], versions, metric, _METERS)
        return dispersion, convergence, errors


def _add(
    family: HistogramMetricFamily,
    labels: Sequence[str],
    versions: Sequence[ModelAggregate],
    metric: int,
    bounds: Floats,
) -> None:
    counts = np.sum([version.count_up_to(metric, bounds) for version in versions], axis=0)
    buckets = [(f"{bound:g}", count) for bound, count in zip(bounds.tolist(), counts.tolist(), strict=True)]
    buckets.append(("+Inf", sum(version.instants for version in versions)))
    family.add_metric(labels, buckets=buckets, sum_value=sum(version.sum(metric) for version in versions))
