"""Redis servers shared by the tests; each starts at its first use. Tests that break one start their own."""

from collections.abc import Iterator

import pytest

from loadtest import redis_servers
from loadtest.redis_servers import Cluster, FaultProxy, Process, Sentinels
from tests.service.tracking.store.stores import require_redis


@pytest.fixture(scope="session")
def redis_server() -> Iterator[Process]:
    """One server."""
    require_redis()
    with redis_servers.single() as server:
        yield server


@pytest.fixture(scope="session")
def redis_cluster() -> Iterator[Cluster]:
    """Three masters with a replica each."""
    require_redis()
    with redis_servers.cluster() as cluster:
        yield cluster


@pytest.fixture(scope="session")
def redis_sentinels() -> Iterator[Sentinels]:
    """A master, its replica and three Sentinels."""
    require_redis()
    with redis_servers.sentinels() as sentinels:
        yield sentinels


@pytest.fixture
def redis_proxy(redis_server: Process) -> Iterator[FaultProxy]:
    """The network before the one server."""
    with FaultProxy(redis_server.port) as proxy:
        yield proxy
