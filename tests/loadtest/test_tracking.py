"""Measurement of the cost of tracking, with few calls; the values are not checked."""

import shutil
from collections.abc import Iterator

import pytest

from loadtest import tracking
from loadtest.paired_latency import PairedLatency, Variant
from loadtest.stores import Store, stores

pytestmark = pytest.mark.skipif(shutil.which("redis-server") is None, reason="redis-server is not installed")


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Store]]:
    with stores(tmp_path_factory.mktemp("no-models")) as servers:
        yield servers


def test_pairs_time_each_way_and_count_round_trips(servers: list[Store]) -> None:
    pairs = PairedLatency(servers, ("untracked", "tracked", "recalled"), "kalman")
    times = pairs.measure(2)
    assert {len(own.seconds) for own in times.values()} == {2}
    assert all(own.quantile_ms(0.5) > 0 for own in times.values())
    trips = pairs.round_trips()
    assert trips[Variant("Redis", "untracked")] == 0
    # Fewer where the machine was so slow that Redis was left alone for a while
    assert 0 < trips[Variant("Redis", "tracked")] <= 1
    assert 0 < trips[Variant("Redis", "recalled")] <= 2
    assert not any(count for variant, count in trips.items() if variant.store == "in-process")
    pairs.reset()


def test_agents_are_weighed(servers: list[Store]) -> None:
    alone, shared = (tracking.memory_per_agent(store, rate=2.0, agents=80) for store in servers)
    assert alone.redis == 0
    assert 5_000 < shared.redis < 50_000  # bytes: 17 calls are remembered of each
    assert alone.process > 0


def test_the_tables(servers: list[Store]) -> None:
    times = tracking.latency_table(servers, ["kalman"], rounds=2)
    assert times.row_count == 4
    others = tracking.scaling_table(servers, live=[5, 10], rounds=2)
    assert others.row_count == 2
