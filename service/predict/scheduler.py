"""Scheduling of the forward: how long work takes, what must wait, and which work goes next.

Work of the same priority is ordered by its deadline (earliest deadline first; Liu and Layland 1973). That
order meets every deadline that can be met, but only while there is no more work than the model can do.
Therefore calls that would be late are refused on arrival (``service.predict.admission``), and entries that
have become late are dropped before they take the model's time.
"""

import itertools
from bisect import insort
from collections.abc import Container, Hashable, Iterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, Protocol, TypeVar

_FIRST_RATE = 500.0
"""agents/s; a guess until the first batch has been measured."""
_SMOOTHING = 0.2
_STALE = 20
"""Forwards after which a size that none of them had is expected to be as much slower as the others."""
_MIN_SLOWDOWN = 0.25
"""Part of its rate that such a size keeps at least."""
_PART_SECONDS = 0.003
"""Seconds of work that forwards get at least where several could share it: to hand it over takes 0.5 ms."""
MAX_BATCH_SECONDS = 0.05
"""Seconds that a batch may be expected to take, so that a call with a deadline of 100 ms never finds the
model busy for longer."""
MIN_BATCH_AGENTS = 32
"""A batch may always have so many agents: smaller ones waste the model."""


Order = tuple[float, float]
"""Negative priority and deadline: smaller ones are served first."""


class Departure(StrEnum):
    """Reason why a batch left with the work that it has."""

    EMPTY = "empty"
    """Nothing else waited that could share its forward."""
    SHARE = "share"
    """Other forwards were free for the rest."""
    AGENTS = "agents"
    """It reached the max number of agents."""
    TIME = "time"
    """It reached the time that a batch may take."""
    DEADLINE = "deadline"
    """With more work its most urgent part would have been late."""


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
    def priority(self) -> int:
        """Priority; a higher one goes first."""

    @property
    def finished(self) -> bool:
        """True if the entry has been cancelled or has failed meanwhile."""


AnyWork = TypeVar("AnyWork", bound=Work)


@dataclass
class _Rate:
    """Smoothed rate of the forwards of one size, a power of two."""

    best: float
    """agents/s, the highest rate so far."""
    value: float
    """agents/s."""
    forward: int
    """Number of the last forward of that size."""
    speed: float
    """Speed of all sizes then."""


class _Rates:
    """Rates of the forwards that can be shared, by size.

    A size that has not occurred for long, such as the largest since warm-up, becomes slower and faster as the
    others do: under load all forwards take longer. The speed is the smoothed share of the best rates.
    """

    def __init__(self) -> None:
        self._sizes: dict[int, _Rate] = {}
        self._forwards = 0
        self._speed = 1.0

    def measure(self, agents: int, rate: float) -> None:
        """Learn from a forward."""
        self._forwards += 1
        new = _Rate(rate / self._speed, rate, self._forwards, self._speed)
        own = self._sizes.setdefault(agents.bit_length(), new)
        own.value = self._expected(own)
        own.value += _SMOOTHING * (rate - own.value)
        own.best = max(own.best, rate)
        self._speed += _SMOOTHING * (rate / own.best - self._speed)
        own.forward, own.speed = self._forwards, self._speed

    def of(self, agents: int) -> float:
        """Return the rate of the known size that is nearest, the larger one of two, agents/s."""
        size = agents.bit_length()
        return self._expected(self._sizes[min(self._sizes, key=lambda one: (abs(one - size), -one))])

    def batch_agents(self, seconds: float) -> int:
        """Return the number of agents of the largest forward that takes so many seconds."""
        largest = max(self._sizes)
        # The agents that each rate allows, of a size that has it; larger batches have that of the largest
        fitting = ((size, int(seconds * self._expected(own))) for size, own in self._sizes.items())
        return max(agents if size == largest else min(agents, 2**size - 1) for size, agents in fitting)

    def _expected(self, own: _Rate) -> float:
        if own.forward > self._forwards - _STALE:
            return own.value
        return min(own.value * max(self._speed / own.speed, _MIN_SLOWDOWN), own.best)


class CostModel:
    """Smoothed rates of forwards, by the key of what shares them and by size, and the work around them.

    A forward of one agent takes far more than a hundredth of one of a hundred, so each power of two has its
    own rate.
    """

    def __init__(self) -> None:
        self._rates: dict[Hashable, _Rates] = {}
        self._last_key: Hashable = None
        self.forwards = 1
        """Number of forwards that may share a call."""
        self._around: dict[int, float] = {}
        self.after = 0.0
        """Smoothed seconds from the end of a call's last forward until it is answered."""

    def seconds(self, key: Hashable, agents: int) -> float:
        """Return the expected seconds of a forward of so many agents."""
        known = self._known(key)
        return agents / (known.of(agents) if known else _FIRST_RATE)

    def seconds_of_unknown(self, agents: int) -> float:
        """Return the expected seconds of a forward by a model that is not known yet."""
        return self.seconds(self._last_key, agents)

    def batch_agents(self, key: Hashable, max_agents: int) -> int:
        """Return the max number of agents in a batch: so many as ``MAX_BATCH_SECONDS`` allows.

        Args:
            key: key of the batch's work.
            max_agents: the max number in any case.
        """
        known = self._known(key)
        within = known.batch_agents(MAX_BATCH_SECONDS) if known else int(MAX_BATCH_SECONDS * _FIRST_RATE)
        return min(max_agents, max(within, MIN_BATCH_AGENTS))

    def share(self, key: Hashable, agents: int, forwards: int) -> int:
        """Return the number of agents for each of several free forwards; one of them gets all of a few."""
        parts = min(forwards, self.forwards, int(self.seconds(key, agents) / _PART_SECONDS))
        return max(-(-agents // max(parts, 1)), 1)

    def measure(self, key: Hashable, agents: int, seconds: float, usual: bool = True) -> None:
        """Learn from a forward.

        Args:
            key: what can share it.
            agents: number of agents.
            seconds: its duration.
            usual: whether the next calls may be expected to need such a forward.
        """
        rate = agents / max(seconds, 1e-6)
        self._rates.setdefault(key, _Rates()).measure(agents, rate)
        if usual:
            self._last_key = key

    def forget(self, models: Container[Hashable]) -> None:
        """Forget some models, the first part of their keys."""
        gone = [key for key in self._rates if isinstance(key, tuple) and key[0] in models]
        for key in gone:
            del self._rates[key]
        if self._last_key in gone:
            self._last_key = next(iter(self._rates), None)

    def measure_around(self, agents: int, seconds: float, after: float) -> None:
        """Learn from a call that was answered.

        Args:
            agents: number of its agents.
            seconds: seconds of work for it outside the model, planning and encoding.
            after: seconds from the end of its last forward until it was answered.
        """
        size = agents.bit_length()
        known = self._around.get(size, seconds)
        self._around[size] = known + _SMOOTHING * (seconds - known)
        self.after += _SMOOTHING * (max(after, 0.0) - self.after)

    def around(self, agents: int) -> float:
        """Return the expected seconds of work outside the model for a call of so many agents.

        They are those of the size that is nearest among those that have been answered. Of a larger one a
        smaller call is expected to take its part; a larger call than those is not expected to take more, lest
        it be refused because of a guess.
        """
        if not self._around:
            return 0.0
        size = agents.bit_length()
        nearest = min(self._around, key=lambda one: (abs(one - size), -one))
        return self._around[nearest] * min(2.0 ** (size - nearest), 1.0)

    def alone(self, agents: int) -> float:
        """Return the expected seconds until a call is done that no other keeps waiting: forwards share it."""
        share = self.share(self._last_key, agents, self.forwards)
        return self.seconds_of_unknown(share) + self.around(agents)

    def work(self, agents: int) -> float:
        """Return the expected seconds of all work for a call, by a model that is not known yet."""
        return self.seconds_of_unknown(agents) + self.around(agents)

    def _known(self, key: Hashable) -> _Rates | None:
        """Return the rates of a key, those of another one if nothing is known of it."""
        return self._rates.get(key) or self._rates.get(self._last_key)


class DeadlineQueue(Generic[AnyWork]):
    """Queue of work by priority and deadline; equal ones in order of arrival."""

    def __init__(self, costs: CostModel) -> None:
        self._costs = costs
        self._entries: list[tuple[Order, int, AnyWork]] = []
        self._numbers = itertools.count()

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[AnyWork]:
        return (entry for _, _, entry in self._entries)

    @property
    def agents(self) -> int:
        """Number of agents in the queue."""
        return sum(entry.agents for entry in self)

    def put(self, entry: AnyWork, lag: float = 0.0) -> None:
        """Add an entry.

        Args:
            entry: the entry.
            lag: seconds by which it is ordered behind its deadline. Later parts of a large call lag behind
                its first, so that small calls which arrive meanwhile need not wait for all of them.
        """
        order = (-entry.priority, entry.deadline + lag)
        insort(self._entries, (order, next(self._numbers), entry))

    def remove(self, entry: AnyWork) -> None:
        """Remove an entry if it is still queued."""
        self._entries = [one for one in self._entries if one[2] is not entry]

    def clear(self) -> None:
        """Remove all entries."""
        self._entries.clear()

    def take_batch(
        self, now: float, max_agents: int, share: int | None = None
    ) -> tuple[list[AnyWork], list[AnyWork], Departure]:
        """Take the most urgent entry and what can share its forward, in order.

        A batch ends at the first entry of its key that does not fit, which nothing of that key may overtake.
        Where all entries are expected to be late, the first one that is not yet late is taken anyway:
        otherwise a wrong estimate could never be corrected.

        Args:
            now: the time on the clock of the deadlines, s.
            max_agents: the max number of agents in a batch.
            share: the number of agents after which the rest is for other forwards, which are free.

        Returns:
            The batch, the entries that cannot meet their deadlines any more, and why the batch has no more
            entries. Both have left the queue.
        """
        late: list[AnyWork] = []
        rest: list[tuple[Order, int, AnyWork]] = []
        batch: _Batch[AnyWork] | None = None
        for item in self._entries:
            entry = item[2]
            if entry.finished:
                continue
            if entry.deadline < now + self._costs.seconds(entry.key, entry.agents) + self._costs.after:
                late.append(entry)
            elif batch is None:
                batch = _Batch(entry, self._costs, now, max_agents, share)
            elif not batch.add(entry):
                rest.append(item)
        self._entries = rest
        if batch is not None:
            return batch.entries, late, batch.departure
        possible = next((entry for entry in late if entry.deadline > now), None)
        if possible is None:
            return [], late, Departure.EMPTY
        late.remove(possible)
        return [possible], late, Departure.DEADLINE


class _Batch(Generic[AnyWork]):
    """Entries that share a forward."""

    def __init__(
        self, first: AnyWork, costs: CostModel, now: float, max_agents: int, share: int | None
    ) -> None:
        self.entries = [first]
        self.departure = Departure.EMPTY
        self._costs = costs
        self._agents = first.agents
        self._max_agents = max_agents
        self._limit = costs.batch_agents(first.key, max_agents)
        self._share = share
        self._deadline = first.deadline
        self._start = now + costs.after

    def add(self, entry: AnyWork) -> bool:
        """Add an entry if it fits; return whether it did. After one that did not none does."""
        first = self.entries[0]
        if self.departure is not Departure.EMPTY or entry.key != first.key:
            return False
        agents = self._agents + entry.agents
        deadline = min(self._deadline, entry.deadline)
        if self._share is not None and agents > self._share:
            self.departure = Departure.SHARE
        elif agents > self._limit:
            self.departure = Departure.AGENTS if self._limit == self._max_agents else Departure.TIME
        elif self._start + self._costs.seconds(entry.key, agents) > deadline:
            self.departure = Departure.DEADLINE
        else:
            self.entries.append(entry)
            self._agents, self._deadline = agents, deadline
            return True
        return False
