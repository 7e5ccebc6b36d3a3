"""Servers that the tests share; each starts when it is first asked for. Who breaks one has one of its own."""

from collections.abc import Iterator

import pytest

from tests.service.tracking.store import redis_servers
from tests.service.tracking.store.redis_servers import Cluster, FaultProxy, Process, Sentinels


@pytest.fixture(scope="session")
def redis_server() -> Iterator[Process]:
    """One server."""
    with redis_servers.single() as server:
        yield server


@pytest.fixture(scope="session")
def redis_cluster() -> Iterator[Cluster]:
    """Three masters with a replica each."""
    with redis_servers.cluster() as cluster:
        yield cluster


@pytest.fixture(scope="session")
def redis_sentinels() -> Iterator[Sentinels]:
    """A master, its replica and three Sentinels."""
    with redis_servers.sentinels() as sentinels:
        yield sentinels


@pytest.fixture
def redis_proxy(redis_server: Process) -> Iterator[FaultProxy]:
    """The network before the one server."""
    with FaultProxy(redis_server.port) as proxy:
        yield proxy
