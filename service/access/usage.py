"""Use that one key makes of the server: agents per second, agents in progress, streams."""

import time
from collections.abc import Callable

from service.access.key_file import Key
from service.errors import LimitExceeded, TooLarge

BURST_SECONDS = 1.0
"""Seconds of its rate that an idle key may use at once."""
_RETRY_AFTER = 0.1
"""Seconds after which a call that was beyond the agents in progress may be tried again."""


class Usage:
    """Use of one key, within its limits. Used on one event loop.

    The rate is a bucket that fills with agents. A request with more agents than the bucket holds is accepted
    when the bucket is full, and leaves a debt; so on average the rate holds for requests of any size.
    """

    def __init__(self, limits: Key, clock: Callable[[], float] = time.monotonic) -> None:
        """
        Args:
            limits: the key.
            clock: returns seconds.
        """
        self._clock = clock
        self._limits = limits
        self._level = self._capacity
        self._filled = clock()
        self.agents = 0
        """Number of agents in progress."""
        self.streams = 0
        """Number of open streams."""

    @property
    def limits(self) -> Key:
        """The key with its limits."""
        return self._limits

    def change(self, limits: Key) -> None:
        """Apply other limits; what is in progress goes on."""
        self._fill()
        self._limits = limits
        self._level = min(self._level, self._capacity)

    def take(self, agents: int, refund: int = 0) -> None:
        """Take agents from the bucket.

        Args:
            agents: number of agents.
            refund: agents that the same request took before, and that these include.

        Raises:
            LimitExceeded: the bucket holds too few; nothing is taken.
        """
        rate = self._limits.agents_per_second
        if rate is None:
            return
        self._fill()
        missing = min(agents, self._capacity) - refund - self._level
        if missing > 0:
            raise LimitExceeded(f"the key may send {rate:g} agents per second", missing / rate)
        self._level -= agents - refund

    def hold(self, agents: int, held: int = 0) -> None:
        """Count agents as in progress.

        Args:
            agents: number of agents.
            held: agents of the same request that are counted already, and that these include.

        Raises:
            TooLarge: the key may never have so many in progress.
            LimitExceeded: with those in progress there are too many; nothing changes.
        """
        limit = self._limits.concurrent_agents
        if limit is not None:
            if agents > limit:
                raise TooLarge(
                    f"the request has {agents} agents; the key may have {limit} in progress at a time"
                )
            if self.agents - held + agents > limit:
                raise LimitExceeded(
                    f"{self.agents - held} agents of the key are in progress; at most {limit} may be",
                    _RETRY_AFTER,
                )
        self.agents += agents - held

    def open_stream(self) -> None:
        """Count a stream.

        Raises:
            LimitExceeded: there are too many.
        """
        limit = self._limits.streams
        if limit is not None and self.streams >= limit:
            raise LimitExceeded(f"{self.streams} streams of the key are open; at most {limit} may be", 1.0)
        self.streams += 1

    @property
    def _capacity(self) -> float:
        """Number of agents that the bucket holds; at least one, or no request would ever fit."""
        return max((self._limits.agents_per_second or 0.0) * BURST_SECONDS, 1.0)

    def _fill(self) -> None:
        now = self._clock()
        rate = self._limits.agents_per_second
        if rate is not None:
            self._level = min(self._capacity, self._level + (now - self._filled) * rate)
        self._filled = now
