"""The client of a Redis Cluster: redis-py's, but it waits boundedly, follows redirections and recovers."""

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
"""Connections to a node beyond those of commands: for subscriptions."""
_REFRESH_TIMEOUTS = 2
"""Nodes that hang in turn before a look at the topology is given up. Another one begins with other nodes."""


class Cluster(RedisCluster):
    """A client that waits for a free connection, and only so long."""

    def __init__(
        self, endpoints: Sequence[Endpoint], *, connections: int, timeout_s: float, **options: Any
    ) -> None:
        """
        Args:
            endpoints: nodes to begin with.
            connections: commands at a time.
            timeout_s: s that a command waits until there are fewer; and that a node is waited for.
            options: of ``RedisCluster``.
        """
        super().__init__(
            startup_nodes=[ClusterNode(each.host, each.port) for each in endpoints],
            max_connections=connections + _SPARE,
            retry=Retry(NoBackoff(), 0),  # of whole commands; redirections are followed anyway
            reinitialize_steps=0,  # otherwise each fifth redirection closes all connections, used or not
            **options,
        )
        self.commands_parser = _CommandsIfNeeded()
        self._endpoints = endpoints
        self._timeout_s = timeout_s
        self._places = asyncio.Semaphore(connections)
        self._refresh: asyncio.Task[RedisCluster] | None = None

    async def execute_command(self, *args: EncodableT, **kwargs: Any) -> Any:
        """As redis-py's, but it waits where that one would fail: for a connection.

        Raises:
            MaxConnectionsError: there was none in time.
            RedisConnectionError: it was lost.
        """
        try:
            async with asyncio.timeout(self._timeout_s):
                await self._places.acquire()
        except TimeoutError:
            raise MaxConnectionsError("no connection became free") from None
        try:
            if not self.get_default_node():  # redis-py would begin with any node, and be sent on
                await self.initialize()
            return await super().execute_command(*args, **kwargs)
        except AttributeError as error:  # there is no writer: a call that failed has closed all connections
            raise RedisConnectionError("the connection was closed") from error
        finally:
            self._places.release()

    async def initialize(
        self,
        additional_startup_nodes_info: list[tuple[str, int]] | None = None,
        last_failed_node_name: str | None = None,
    ) -> RedisCluster:
        """Looks at the topology, if that is due.

        Whoever comes meanwhile shares the result: in redis-py each waits for the one before it to have failed
        and then tries by itself.
        """
        if self._refresh is None:
            self._refresh = asyncio.create_task(
                self._look(additional_startup_nodes_info, last_failed_node_name), name="cluster topology"
            )
            self._refresh.add_done_callback(self._looked)
        return await asyncio.shield(self._refresh)

    async def aclose(self) -> None:
        """Closes all connections. redis-py's leaves them open while a look at the topology is due."""
        if self._refresh is not None:  # or it would open some more
            await asyncio.wait((self._refresh,))
        await super().aclose()
        await self.nodes_manager.aclose()
        await self.nodes_manager.aclose("startup_nodes")

    def get_node(
        self, host: str | None = None, port: int | None = None, node_name: str | None = None
    ) -> ClusterNode | None:
        """The node, None if it is not known. By name redis-py asks for the one that a slot is moving to."""
        node = super().get_node(host, port, node_name)
        return _Target(node) if node is not None and node_name else node

    async def _look(self, more: list[tuple[str, int]] | None, last_failed: str | None) -> RedisCluster:
        try:
            async with asyncio.timeout(_REFRESH_TIMEOUTS * self._timeout_s):
                return await super().initialize(more, last_failed)
        except Exception:
            # By now redis-py knows only the addresses that the cluster itself had told. All of them may have
            # changed, so the ones that we were given are asked, too.
            known = self.nodes_manager.startup_nodes
            for each in self._endpoints:
                node = ClusterNode(each.host, each.port, **self.nodes_manager.connection_kwargs)
                known.setdefault(node.name, node)
            raise

    def _looked(self, refresh: "asyncio.Task[RedisCluster]") -> None:
        self._refresh = None
        if not refresh.cancelled():
            refresh.exception()  # looked at, or asyncio would complain where nobody waits for it any more


class _Target(ClusterNode):
    """A node that a slot is moving to, for one command that was sent on to it.

    The node obeys if ASKING came just before on the same connection. redis-py sends it on whichever is free,
    and so the command on another one if there are several.
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
    """What the cluster says of its commands, if one is called of which redis-py knows nothing.

    redis-py asks for all of them at each look at the topology and then parses for 40 ms, in which the event
    loop does nothing else. For EVALSHA and its like it needs none of it.
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
