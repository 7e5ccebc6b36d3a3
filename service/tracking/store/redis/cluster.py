"""Redis Cluster client: redis-py's, with bounded waits, correct redirections and recovery."""

import asyncio
from collections.abc import Sequence
from typing import Any

from redis._parsers import AsyncCommandsParser
from redis.asyncio.cluster import ClusterNode, PipelineCommand, RedisCluster
from redis.asyncio.retry import Retry
from redis.backoff import NoBackoff
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import MaxConnectionsError
from redis.typing import EncodableT

from service.redis_url import Endpoint

_SPARE = 4
"""Connections per node beyond those for commands, for subscriptions."""
_REFRESH_TIMEOUTS = 2
"""Hanging nodes after which a topology refresh is abandoned; the next one begins with other nodes."""


class Cluster(RedisCluster):
    """Cluster client that waits for a free connection, up to a timeout."""

    def __init__(
        self, endpoints: Sequence[Endpoint], *, connections: int, timeout_s: float, **options: Any
    ) -> None:
        """
        Args:
            endpoints: initial nodes.
            connections: concurrent commands, at most.
            timeout_s: seconds that a command waits for its turn, and that a node may take.
            options: options of ``RedisCluster``.
        """
        super().__init__(
            startup_nodes=[ClusterNode(each.host, each.port) for each in endpoints],
            max_connections=connections + _SPARE,
            retry=Retry(NoBackoff(), 0),  # retries of whole commands; redirections are still followed
            reinitialize_steps=0,  # else each fifth redirection closes all connections, also those in use
            **options,
        )
        self.commands_parser = _CommandsIfNeeded()
        self._endpoints = endpoints
        self._timeout_s = timeout_s
        self._places = asyncio.Semaphore(connections)
        self._refresh: asyncio.Task[RedisCluster] | None = None

    async def execute_command(self, *args: EncodableT, **kwargs: Any) -> Any:
        """Execute a command as redis-py does, but wait for a free connection instead of failing.

        Raises:
            MaxConnectionsError: no connection became free in time.
            RedisConnectionError: the connection was lost.
        """
        try:
            async with asyncio.timeout(self._timeout_s):
                await self._places.acquire()
        except TimeoutError:
            raise MaxConnectionsError("no connection became free") from None
        try:
            if not self.get_default_node():  # redis-py would start at any node and be redirected
                await self.initialize()
            return await super().execute_command(*args, **kwargs)
        except AttributeError as error:  # no writer: a failed call has closed all connections
            raise RedisConnectionError("the connection was closed") from error
        finally:
            self._places.release()

    async def initialize(
        self,
        additional_startup_nodes_info: list[tuple[str, int]] | None = None,
        last_failed_node_name: str | None = None,
    ) -> RedisCluster:
        """Refresh the topology if necessary.

        Concurrent callers share one refresh. In redis-py each waits until the previous one has failed, then
        tries again itself.
        """
        if self._refresh is None:
            self._refresh = asyncio.create_task(
                self._refresh_topology(additional_startup_nodes_info, last_failed_node_name),
                name="cluster topology",
            )
            self._refresh.add_done_callback(self._on_refreshed)
        return await asyncio.shield(self._refresh)

    async def aclose(self) -> None:
        """Close all connections; redis-py leaves them open while a topology refresh is due."""
        if self._refresh is not None:  # it would open new connections
            await asyncio.wait((self._refresh,))
        await super().aclose()
        await self.nodes_manager.aclose()
        await self.nodes_manager.aclose("startup_nodes")

    def get_node(
        self, host: str | None = None, port: int | None = None, node_name: str | None = None
    ) -> ClusterNode | None:
        """Return a node; None: it is unknown. Calls by name ask for the node that a slot is moving to."""
        node = super().get_node(host, port, node_name)
        return _Target(node) if node is not None and node_name else node

    async def _refresh_topology(
        self, more: list[tuple[str, int]] | None, last_failed: str | None
    ) -> RedisCluster:
        try:
            async with asyncio.timeout(_REFRESH_TIMEOUTS * self._timeout_s):
                return await super().initialize(more, last_failed)
        except Exception:
            # redis-py now knows only the addresses that the cluster announced. All of them may have changed,
            # so the configured ones are added again.
            known = self.nodes_manager.startup_nodes
            for each in self._endpoints:
                node = ClusterNode(each.host, each.port, **self.nodes_manager.connection_kwargs)
                known.setdefault(node.name, node)
            raise

    def _on_refreshed(self, refresh: "asyncio.Task[RedisCluster]") -> None:
        self._refresh = None
        if not refresh.cancelled():
            refresh.exception()  # else asyncio logs an exception that nobody retrieves


class _Target(ClusterNode):
    """Node that a slot is moving to, for one redirected command.

    The node accepts the command only after ASKING on the same connection. redis-py sends the two on any free
    connections, which may differ.
    """

    def __init__(self, node: ClusterNode) -> None:
        super().__init__(node.host, node.port, node.server_type)
        self._node = node
        self._asking = False

    async def execute_command(self, *args: Any, asking: bool = False, **kwargs: Any) -> Any:
        if args == ("ASKING",):
            self._asking = True
            return None
        if not self._asking:
            return await self._node.execute_command(*args, asking=asking, **kwargs)
        self._asking = False
        both = [PipelineCommand(0, "ASKING"), PipelineCommand(1, *args, **kwargs)]
        await self._node.execute_pipeline(both)
        for command in both:
            if isinstance(command.result, Exception):
                raise command.result
        return both[1].result

    def update_active_connections_for_reconnect(self) -> None:
        self._node.update_active_connections_for_reconnect()

    async def disconnect_free_connections(self) -> None:
        await self._node.disconnect_free_connections()


class _CommandsIfNeeded(AsyncCommandsParser):
    """Command table of the cluster, loaded only for a command that redis-py does not know.

    redis-py loads the table at each topology refresh, and parsing it blocks the event loop for 40 ms. EVALSHA
    and the other commands used here do not need it.
    """

    def __init__(self) -> None:
        super().__init__()
        self._lock = asyncio.Lock()

    async def initialize(self, node: ClusterNode | None = None) -> None:
        if node is not None:
            self.node = node
            return
        async with self._lock:
            if not self.commands:
                await super().initialize()
