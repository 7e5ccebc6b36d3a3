"""Callers whose credentials were accepted, and their calls."""

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager

from service.access.key_file import Key
from service.access.scopes import Scope
from service.access.usage import Usage
from service.errors import PermissionDenied, ServiceError, Unauthenticated
from service.telemetry.metrics import Metrics

_REVOKED = "the key was revoked"


class Caller:
    """Holder of a key. Used on one event loop."""

    def __init__(self, key: Key, metrics: Metrics | None = None) -> None:
        """
        Args:
            key: name, scopes and limits.
            metrics: counts the calls by the key's name; None: they are not counted.
        """
        self._key = key
        self._usage = Usage(key)
        self._metrics = metrics
        self._watching: set[asyncio.Timeout] = set()
        self._revoked = False
        if metrics is not None:
            metrics.keys.add(key.name)

    @property
    def name(self) -> str | None:
        """Name of the key in metrics; None: its calls are not counted."""
        return None if self._metrics is None else self._key.name

    def change(self, key: Key) -> None:
        """Apply other scopes and limits; what is in progress goes on."""
        self._key = key
        self._usage.change(key)

    def revoke(self) -> None:
        """End the open streams, and refuse further ones; calls in progress go on."""
        self._revoked = True
        now = asyncio.get_running_loop().time()
        for timeout in self._watching:
            timeout.reschedule(now)

    def require(self, scope: Scope | None) -> None:
        """Refuse a call that needs another scope.

        Args:
            scope: the scope; None: every caller may call.

        Raises:
            PermissionDenied: the key lacks the scope.
        """
        if scope is not None and scope not in self._key.scopes:
            self._count_refusal("scope")
            raise PermissionDenied(f"the key lacks the scope {scope.value}")

    @contextmanager
    def call(self) -> Iterator["Grant"]:
        """Count a call, with one agent, until the block ends.

        Raises:
            LimitExceeded: the key has reached its rate, or its number of agents in progress.
        """
        grant = Grant(self)
        grant.charge(1)
        try:
            yield grant
        finally:
            self._usage.agents -= grant.agents

    @asynccontextmanager
    async def stream(self) -> AsyncIterator[None]:
        """Count a stream until the block ends, and end the block when the key is revoked.

        Raises:
            LimitExceeded: the key has reached its rate, or its number of streams.
            Unauthenticated: the key was revoked.
        """
        if self._revoked:  # since the caller was identified
            raise Unauthenticated(_REVOKED)
        with self._counting_refusals():
            self._usage.take(1)
            self._usage.open_stream()
        timeout = asyncio.timeout(None)
        self._watching.add(timeout)
        try:
            async with timeout:
                yield
        except TimeoutError:
            if not timeout.expired():
                raise
            raise Unauthenticated(_REVOKED) from None
        finally:
            self._watching.remove(timeout)
            self._usage.streams -= 1

    def use(self, agents: int, before: int) -> None:
        """Count the agents of a call.

        Args:
            agents: number of agents of the call.
            before: number that was counted for it before.

        Raises:
            TooLarge: the key may never have so many in progress.
            LimitExceeded: the key has reached a limit; nothing changes.
        """
        with self._counting_refusals():
            self._usage.hold(agents, before)
            try:
                self._usage.take(agents, before)
            except ServiceError:
                self._usage.hold(before, agents)
                raise
        if self._metrics is not None:
            self._metrics.keys.agents.labels(self._key.name).inc(agents - before)

    @contextmanager
    def _counting_refusals(self) -> Iterator[None]:
        try:
            yield
        except ServiceError:
            self._count_refusal("limit")
            raise

    def _count_refusal(self, reason: str) -> None:
        if self._metrics is not None:
            self._metrics.keys.refused.labels(self._key.name, reason).inc()


class Grant:
    """A call of a caller, and the agents that it counts."""

    def __init__(self, caller: Caller) -> None:
        self.caller = caller
        self.agents = 0
        """Number of agents counted."""

    def charge(self, agents: int) -> None:
        """Count the agents of the request, once they are known.

        Args:
            agents: number of agents; a request without any counts as one.

        Raises:
            TooLarge: the key may never have so many in progress.
            LimitExceeded: the key has reached a limit.
        """
        agents = max(agents, 1)
        self.caller.use(agents, self.agents)
        self.agents = agents
