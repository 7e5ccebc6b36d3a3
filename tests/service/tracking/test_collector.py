"""Prometheus metrics of the track memory."""

import asyncio
import pickle
from collections.abc import Sequence

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from service.tracking.aggregates import Aggregates
from service.tracking.collector import ConsistencyCollector, StoreMetrics
from service.tracking.metrics import instant_metrics
from service.tracking.model_references import ModelReferences
from service.tracking.store.guard import Guard
from service.tracking.store.memory import MemoryStore
from service.tracking.tracker import Tracker
from tests.service.fakes import FakeForecaster
from tests.service.servers import call_grpc, running
from tests.service.tracking.store.track_updates import times, track_update
from tests.service.tracking.test_metrics import instants
from tests.service.tracks import made_up


def test_histograms_of_what_was_settled() -> None:
    made, aggregates, registry = instants(100), Aggregates(), CollectorRegistry()
    registry.register(ConsistencyCollector(aggregates))
    assert b"_bucket" not in generate_latest(registry)
    found = instant_metrics(made.tobytes())
    aggregates.add(found, ["cab@1.0.0"] * 60 + ["cab@1.1.0"] * 40, newly_only=True)
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


async def test_a_scrape_reads_and_changes_nothing() -> None:
    """Two scrapes in a row are equal, and what waits to be aggregated still waits after them."""
    registry = CollectorRegistry()
    guard, query_guard = (Guard(lambda *_: None, lambda *_: None) for _ in range(2))
    tracker = Tracker(MemoryStore(30.0, 100), guard, query_guard, 10.0, ModelReferences())
    registry.register(ConsistencyCollector(tracker.aggregates))

    async def exchange(moments: Sequence[float]) -> None:
        for moment in moments:
            await tracker.exchange("scene", moment, [track_update(moment)], 10.0)

    moments = times(15)
    await exchange(moments[:14])
    tracker.aggregate_pending()
    await exchange(moments[14:])
    state = aggregates_state(tracker)
    pending = list(tracker._pending)
    assert pending
    first = generate_latest(registry)
    assert generate_latest(registry) == first
    assert aggregates_state(tracker) == state
    assert tracker._pending == pending
    tracker.aggregate_pending()
    assert generate_latest(registry) != first


def aggregates_state(tracker: Tracker) -> bytes:
    """Return the whole state of the aggregates."""
    return pickle.dumps(tracker.aggregates)


async def test_two_scrapes_of_a_server_are_equal() -> None:
    tracks = made_up("scene", agents=2)
    async with running(FakeForecaster(), store_budget_ms=5000.0) as server:
        for frame in range(1, 20):
            await call_grpc(server, tracks.request(frame, "fake"))
        await asyncio.sleep(0.05)  # until all is aggregated
        first, second = (own_lines(server.metrics.render()) for _ in range(2))
    assert first == second
    assert any(line.startswith("forecast_dispersion_meters_count") for line in first)


def own_lines(text: bytes) -> list[str]:
    """Return the lines of the service's own metrics; those of the process change by themselves."""
    return [line for line in text.decode().splitlines() if line.startswith("forecast_")]
