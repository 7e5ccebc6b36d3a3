"""Scheduling of the forward: how long work takes, what must wait, and which work goes next.

Work is ordered by its deadline (earliest deadline first; Liu and Layland 1973). That order meets every
deadline that can be met, but only while there is no more work than the model can do. Therefore calls that
would be late are refused on arrival, and entries that have become late are dropped before they take the
model's time.
"""

import itertools
import math
from bisect import bisect_left, bisect_right, insort
from collections import Counter
from collections.abc import Container, Hashable, Iterator
from typing import Generic, Protocol, TypeVar

_FIRST_RATE = 500.0
"""agents/s; a guess until the first batch has been measured."""
_SMOOTHING = 0.2
_KEPT = 0.95
"""Weight of earlier answers in the throughput: about the last twenty count."""
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
    """Smoothed rates of forwards, by the key of what shares them and by size, and the time around them.

    A forward of one agent takes far more than a hundredth of one of a hundred, so each power of two has its
    own rate.
    """

    def __init__(self) -> None:
        self._rates: dict[Hashable, dict[int, float]] = {}
        self._last_key: Hashable = None
        self.around = 0.0
        """Smoothed seconds of work for a call outside the model: planning and encoding."""

    def seconds(self, key: Hashable, agents: int) -> float:
        """Return the expected seconds of a forward of so many agents."""
        return agents / self._rate(key, agents)

    def seconds_of_unknown(self, agents: int) -> float:
        """Return the expected seconds of a forward by a model that is not known yet."""
        return self.seconds(self._last_key, agents)

    def batch_agents(self, key: Hashable, max_agents: int) -> int:
        """Return the max number of agents in a batch: so many as ``MAX_BATCH_SECONDS`` allows.

        Args:
            key: key of the batch's work.
            max_agents: the max number in any case.
        """
        known = self._rates.get(key) or self._rates.get(self._last_key) or {0: _FIRST_RATE}
        largest = max(known)
        # The agents that each rate allows, of a size that has it; larger batches have that of the largest
        fitting = ((size, int(MAX_BATCH_SECONDS * rate)) for size, rate in known.items())
        within = max(agents if size == largest else min(agents, 2**size - 1) for size, agents in fitting)
        return min(max_agents, max(within, MIN_BATCH_AGENTS))

    def measure(self, key: Hashable, agents: int, seconds: float, usual: bool = True) -> None:
        """Learn from a forward.

        Args:
            key: what can share it.
            agents: number of agents.
            seconds: its duration.
            usual: whether the next calls may be expected to need such a forward.
        """
        rate = agents / max(seconds, 1e-6)
        known = self._rates.setdefault(key, {})
        size = agents.bit_length()
        known[size] = known.get(size, rate) + _SMOOTHING * (rate - known.get(size, rate))
        if usual:
            self._last_key = key

    def forget(self, models: Container[Hashable]) -> None:
        """Forget some models, the first part of their keys."""
        gone = [key for key in self._rates if isinstance(key, tuple) and key[0] in models]
        for key in gone:
            del self._rates[key]
        if self._last_key in gone:
            self._last_key = next(iter(self._rates), None)

    def measure_around(self, seconds: float) -> None:
        """Learn from a call that was answered."""
        self.around += _SMOOTHING * (max(seconds, 0.0) - self.around)

    def _rate(self, key: Hashable, agents: int) -> float:
        """Return the rate of the known size that is nearest, the larger one of two."""
        known = self._rates.get(key) or self._rates.get(self._last_key)
        if not known:
            return _FIRST_RATE
        size = agents.bit_length()
        return known[min(known, key=lambda one: (abs(one - size), -one))]


class Throughput:
    """Rate at which calls are finished, and the calls that are worked on.

    It knows what the costs of forwards do not: that calls wait for the interpreter, for helper threads and
    for busy neighbours. By Little's law a new call takes as long as the calls before it at that rate.
    """

    def __init__(self) -> None:
        self._deadlines: list[float] = []
        self._seconds = 0.0
        self._calls = 0.0
        self._since = 0.0

    def begin(self, deadline: float, now: float) -> None:
        """Begin a call."""
        if not self._deadlines:
            self._since = now
        insort(self._deadlines, deadline)

    def end(self, deadline: float, now: float, finished: bool) -> None:
        """End a call.

        Args:
            deadline: its deadline.
            now: the time.
            finished: whether it was answered. The time of other calls counts as that of the next answer.
        """
        del self._deadlines[bisect_left(self._deadlines, deadline)]
        if finished:
            self._seconds = _KEPT * self._seconds + now - self._since
            self._calls = _KEPT * self._calls + 1
            self._since = now

    def seconds_until(self, deadline: float) -> float:
        """Return the expected seconds until a new call of that deadline is answered; 0 if nothing waits."""
        if not self._deadlines or not self._calls:
            return 0.0
        return (bisect_right(self._deadlines, deadline) + 1) * self._seconds / self._calls


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

    @property
    def agents(self) -> int:
        """Number of queued agents."""
        return self._agents.total()

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
        Where all entries are expected to be late, the first one that is not yet late is taken anyway:
        otherwise a wrong estimate could never be corrected.

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
                    limit = self._costs.batch_agents(entry.key, max_agents)
                batch.append(entry)
                agents += entry.agents
        if not batch:
            possible = next((entry for entry in late if entry.deadline > now), None)
            if possible is not None:
                late.remove(possible)
                batch.append(possible)
        self._entries = rest
        self._agents = Counter()
        for _, _, entry in rest:
            self._agents[entry.key] += entry.agents
        return batch, late
