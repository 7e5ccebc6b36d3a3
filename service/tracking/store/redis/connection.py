"""Redis clients for all layouts: single server, Sentinel, Cluster.

The clients are redis-py's, configured to fail fast, because callers prefer no result to a late one. A command
is sent once, without retries. Each step (waiting for a free connection, connecting, waiting for the reply)
takes at most the timeout. A timeout or a cancellation in the middle of a call costs the connection: redis-py
closes it, so that no other call gets the reply.
"""

import ssl
from typing import Any

from redis.asyncio import BlockingConnectionPool, Redis, SSLConnection
from redis.asyncio.retry import Retry
from redis.asyncio.sentinel import Sentinel, SentinelConnectionPool
from redis.backoff import NoBackoff

from service.redis_url import Layout, RedisAddress
from service.tracking.store.redis.cluster import Cluster

CLIENT_NAME = "cab-forecast"
"""Client name in CLIENT LIST."""
_HEALTH_CHECK = 15
"""Seconds of idleness after which a connection is checked with a PING before use."""


def connect(address: RedisAddress, *, timeout_s: float, connections: int) -> Redis | Cluster:
    """Return a client, which connects at its first command and reconnects when a connection is lost.

    Args:
        address: address of the server, the Sentinels or the cluster.
        timeout_s: seconds for each step of a command; must exceed the time for which a command blocks.
        connections: connections to the server, at most; commands wait for a free one. In a cluster:
            concurrent commands, and for each node at most a few connections more.

    Returns:
        The client; replies are bytes. The caller closes it with ``aclose``.

    Raises:
        OSError: the CA file does not exist or has no certificates.
    """
    if address.ca_file is not None:
        ssl.create_default_context(cafile=address.ca_file)  # fail now, not at each connection
    # RESP3 allows push messages, with which redis-py no longer checks that a connection is clean before use.
    # Nothing here needs it.
    common: dict[str, Any] = {
        "protocol": 2,
        "socket_timeout": timeout_s,
        "socket_connect_timeout": timeout_s,
        "socket_keepalive": True,
        "health_check_interval": _HEALTH_CHECK,
        "client_name": CLIENT_NAME,
        "driver_info": None,
    }
    if address.tls:  # certificates and host names are verified
        common |= {"ssl": True, "ssl_ca_certs": address.ca_file}
    user: dict[str, Any] = {"username": address.user, "password": address.password}
    if address.layout is Layout.CLUSTER:
        return Cluster(address.endpoints, connections=connections, timeout_s=timeout_s, **common, **user)
    common["retry"] = Retry(NoBackoff(), 0)
    pool: dict[str, Any] = {
        "db": address.database,
        "max_connections": connections,
        "timeout": timeout_s,
    }
    if address.layout is Layout.SENTINEL:
        credentials = {"username": address.sentinel_user, "password": address.sentinel_password}
        sentinels = Sentinel(  # type: ignore[no-untyped-call]
            [(each.host, each.port) for each in address.endpoints], sentinel_kwargs=common | credentials
        )
        client: Redis = sentinels.master_for(
            address.master_name, connection_pool_class=_SentinelPool, **common, **user, **pool
        )
        return client
    (server,) = address.endpoints
    if common.pop("ssl", False):
        common["connection_class"] = SSLConnection
    return Redis.from_pool(
        BlockingConnectionPool(host=server.host, port=server.port, **common, **user, **pool)
    )


class _SentinelPool(SentinelConnectionPool, BlockingConnectionPool):
    """Connections to the master; waits while all are in use, unlike redis-py's pool."""

    async def aclose(self) -> None:
        """Close the connections to the master and to the Sentinels, which only this pool uses."""
        await super().aclose()
        await self.sentinel_manager.aclose()
