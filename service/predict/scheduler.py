"""Scheduling of the forward: how long work takes, what must wait, and which work goes next.

Work is ordered by its deadline (earliest deadline first; Liu and Layland 1973). That order meets every
deadline that can be met, but only while there is no more work than the model can do. Therefore calls that
would be late are refused on arrival, and entries that have become late are dropped before they take the
model's time.
"""

import itertools
import math
from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Hashable, Iterator
from typing import Generic, Protocol, TypeVar

_FIRST_RATE = 500.0
"""agents/s; a guess until the first batch has been measured."""
_SMOOTHING = 0.2
MAX_BATCH_SECONDS = 0.05
"""Seconds that a batch may be expected to take, so that a call with a deadline of 100 ms never finds the
model busy for longer."""
MIN_BATCH_AGENTS = 32
"""A batch may always have so many agents: smaller ones waste the model."""


class Work(Protocol):
    """An entry of the queue."""

    @property
    def key(self) -> Hashable:
        """Key of the entries that can share a forward; the first part names the model."""

    @property
    def agents(self) -> int:
        """Number of agents."""

    @property
    def deadline(self) -> float:
        """Deadline, s."""

    @property
    def finished(self) -> bool:
        """True if the entry has been cancelled or has failed meanwhile."""


AnyWork = TypeVar("AnyWork", bound=Work)


class CostModel:
    """Smoothed rates of forwards, by the key of what shares them, and the time around them."""

    def __init__(self) -> None:
        self._rates: dict[Hashable, float] = {}
        self._last_rate = _FIRST_RATE
        self.around = 0.0
        """Smoothed seconds of a call outside queue and model: decoding, planning and encoding."""

    def seconds(self, key: Hashable, agents: int) -> float:
        """Return the expected seconds of a forward of so many agents."""
        return agents / self._rates.get(key, self._last_rate)

    def seconds_of_unknown(self, agents: int) -> float:
        """Return the expected seconds of a forward by a model that is not known yet."""
        return agents / self._last_rate

    def agents_within(self, key: Hashable, seconds: float) -> int:
        """Return how many agents a forward takes in so many seconds."""
        return int(seconds * self._rates.get(key, self._last_rate))

    def measure(self, key: Hashable, agents: int, seconds: float) -> None:
        """Learn from a forward."""
        rate = agents / max(seconds, 1e-6)
        known = self._rates.get(key)
        self._rates[key] = rate if known is None else known + _SMOOTHING * (rate - known)
        self._last_rate = self._rates[key]

    def measure_around(self, seconds: float) -> None:
        """Learn from a call that was answered."""
        self.around += _SMOOTHING * (max(seconds, 0.0) - self.around)


class DeadlineQueue(Generic[AnyWork]):
    """Queue of work, earliest deadline first; equal deadlines in order of arrival."""

    def __init__(self, costs: CostModel) -> None:
        self._costs = costs
        self._entries: list[tuple[float, int, AnyWork]] = []
        self._numbers = itertools.count()
        self._agents: Counter[Hashable] = Counter()

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[AnyWork]:
        return (entry for _, _, entry in self._entries)

    def put(self, entry: AnyWork, lag: float = 0.0) -> None:
        """Add an entry.

        Args:
            entry: the entry.
            lag: seconds by which it is ordered behind its deadline. Later parts of a large call lag behind
                its first, so that small calls which arrive meanwhile need not wait for all of them.
        """
        insort(self._entries, (entry.deadline + lag, next(self._numbers), entry))
        self._agents[entry.key] += entry.agents

    def remove(self, entry: AnyWork) -> None:
        """Remove an entry if it is still queued."""
        kept = [one for one in self._entries if one[2] is not entry]
        if len(kept) < len(self._entries):
            self._agents[entry.key] -= entry.agents
        self._entries = kept

    def clear(self) -> None:
        """Remove all entries."""
        self._entries.clear()
        self._agents.clear()

    def seconds_before(self, deadline: float) -> float:
        """Return the expected seconds of the queued work that goes before a new entry of that deadline.

        Entries count as equally large: this runs for every call that arrives.
        """
        if not self._entries:
            return 0.0
        share = bisect_right(self._entries, (deadline, math.inf)) / len(self._entries)
        return share * sum(self._costs.seconds(key, agents) for key, agents in self._agents.items())

    def take_batch(self, now: float, max_agents: int) -> tuple[list[AnyWork], list[AnyWork]]:
        """Take the most urgent entry and what can share its forward, in order.

        A batch ends at the first entry of its key that does not fit, which nothing of that key may overtake.

        Args:
            now: the time on the clock of the deadlines, s.
            max_agents: the max number of agents in a batch.

        Returns:
            The batch, and the entries that cannot meet their deadlines any more. Both have left the queue.
        """
        batch: list[AnyWork] = []
        late: list[AnyWork] = []
        rest: list[tuple[float, int, AnyWork]] = []
        agents, limit, full = 0, max_agents, False
        for item in self._entries:
            entry = item[2]
            if entry.finished:
                continue
            if entry.deadline < now + self._costs.seconds(entry.key, entry.agents):
                late.append(entry)
            elif full or (batch and entry.key != batch[0].key):
                rest.append(item)
            elif batch and agents + entry.agents > limit:
                full = True
                rest.append(item)
            else:
                if not batch:
                    within = self._costs.agents_within(entry.key, MAX_BATCH_SECONDS)
                    limit = min(max_agents, max(within, MIN_BATCH_AGENTS))
                batch.append(entry)
                agents += entry.agents
        self._entries = rest
        self._agents = Counter()
        for _, _, entry in rest:
            self._agents[entry.key] += entry.agents
        return batch, late
