"""Clients of Redis, whichever layout it has.

They are redis-py's, set up to fail soon, for whoever calls them would rather do without an answer than wait.
A command is sent once, with no retries, and each thing that it waits for, a free connection, a new one, the
reply, takes at most the timeout. A call that is given up in the middle, by a timeout or a cancellation, costs
the connection: redis-py closes it, so that nobody else gets the reply.
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
"""What CLIENT LIST on the server calls us."""
_HEALTH_CHECK = 15
"""s of silence after which a connection is tried with a PING before it is used."""


def connect(address: RedisAddress, *, timeout_s: float, connections: int) -> Redis | Cluster:
    """A client. It connects when it is first used, and again when a connection was lost.

    Args:
        address: of the server, the Sentinels or the cluster.
        timeout_s: s for each thing that a command waits for; more than a command that blocks does so.
        connections: to the server at most; commands that find none free wait for one. Of a cluster: commands
            at a time, and to each node at most a few connections more.

    Returns:
        The client; replies are bytes. Whoever asked for it closes it, with ``aclose``.

    Raises:
        OSError: there are no certificates in the file of the authorities, or there is no such file.
    """
    if address.ca_file is not None:
        ssl.create_default_context(cafile=address.ca_file)  # better now than at each connection
    # In RESP3 a server may send what nobody asked for, and then redis-py no longer checks that a connection
    # is clean before it is used. Nothing here needs it.
    common: dict[str, Any] = {
        "protocol": 2,
        "socket_timeout": timeout_s,
        "socket_connect_timeout": timeout_s,
        "socket_keepalive": True,
        "health_check_interval": _HEALTH_CHECK,
        "client_name": CLIENT_NAME,
        "driver_info": None,
    }
    if address.tls:  # certificates and the names in them are checked
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
        watchers = Sentinel(  # type: ignore[no-untyped-call]
            [(each.host, each.port) for each in address.endpoints], sentinel_kwargs=common | credentials
        )
        client: Redis = watchers.master_for(
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
    """Connections to the master. It waits while all are in use, which redis-py's own does not."""

    async def aclose(self) -> None:
        """Closes the connections to the Sentinels as well: nobody else has them."""
        await super().aclose()
        await self.sentinel_manager.aclose()
