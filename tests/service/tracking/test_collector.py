"""The series of the track memory."""

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from service.tracking.aggregates import Aggregates
from service.tracking.collector import ConsistencyCollector, StoreMetrics
from service.tracking.metrics import instant_metrics
from tests.service.tracking.test_metrics import instants


def test_histograms_of_what_was_settled() -> None:
    made, sums, registry = instants(100), Aggregates(), CollectorRegistry()
    registry.register(ConsistencyCollector(sums))
    assert b"_bucket" not in generate_latest(registry)
    found = instant_metrics(made.tobytes())
    sums.add(found, ["cab@1.0.0"] * 60 + ["cab@1.1.0"] * 40, newly_only=True)
    families = {f.name: f for f in text_string_to_metric_families(generate_latest(registry).decode())}

    def value(name: str, **labels: str) -> float:
        samples = families[name.removesuffix("_count").removesuffix("_bucket").removesuffix("_sum")].samples
        (one,) = [s.value for s in samples if s.name == name and s.labels == {"model": "cab", **labels}]
        return one

    assert value("forecast_dispersion_meters_count") == 100
    assert abs(value("forecast_dispersion_meters_sum") - found.dispersion.std_m.sum()) < 1e-6
    assert value("forecast_convergence_seconds_count", tau="0.2") == 100
    exact = (found.convergence_s[:, 2] <= 1.0).sum()
    assert value("forecast_convergence_seconds_bucket", tau="5", le="1") == exact
    assert value("forecast_displacement_error_meters_count", horizon="0.5") == 100
    assert (
        abs(value("forecast_displacement_error_meters_sum", horizon="6") - found.errors_m[:, 11].sum()) < 1e-6
    )
    buckets = [
        s.value
        for s in families["forecast_displacement_error_meters"].samples
        if s.name.endswith("_bucket") and s.labels["horizon"] == "3"
    ]
    assert buckets == sorted(buckets)
    assert buckets[-1] == 100


def test_calls_to_the_memory_are_counted() -> None:
    registry = CollectorRegistry()
    metrics = StoreMetrics(registry)
    metrics.observe("exchange", 0.003)
    metrics.failed("exchange", "timeout")
    text = generate_latest(registry).decode()
    assert 'forecast_track_store_seconds_bucket{le="0.005",op="exchange"} 1.0' in text
    assert 'forecast_track_store_errors_total{op="exchange",reason="timeout"} 1.0' in text
