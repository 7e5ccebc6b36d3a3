"""Admission: which calls are accepted, in which order they are worked on, and which are refused.

A call that would be late is refused when it arrives, before its body is read, or at the latest when its size
is known. The expected time follows from the work that goes first and the speed at which work is finished; a
margin that is learned from earlier calls is added. Accepted calls wait for
their turn, by priority and deadline, before features are made of them: so urgent calls overtake others in
time, and what waits takes little memory. Everything runs on the event loop, so there are no locks.
"""

import asyncio
import math
import time
from bisect import bisect_left, bisect_right, insort
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from operator import attrgetter

from service.access.caller import Grant
from service.errors import DeadlineExceeded, Overloaded
from service.predict.scheduler import CostModel, Order
from service.telemetry.metrics import Metrics
from service.telemetry.request_ids import current_request_id

_MIN_RETRY = 0.05
_MAX_RETRY = 10.0
_KEPT = 0.95
"""Weight of earlier answers in the rate: about the last twenty count."""
_MAX_SLOWDOWN = 3.0
"""Max seconds in which a second of work is finished. A small call alone may take longer, which says nothing
about many."""
_GAIN = 1 / 16
_DEVIATIONS = 2.0
"""Mean deviations above the mean within which nearly all calls are finished."""
_FIRST_DEVIATION = 0.1
_MIN_FACTOR, _MAX_FACTOR = 0.5, 4.0
_TRIAL_SECONDS = 1.0
"""Seconds between calls that are accepted even if they are expected to be late."""
_TRANSIT = 0.004
"""Seconds that are left at least for the request and the response on their ways."""
_TRANSIT_SHARE = 0.06
"""Share of the time until the deadline that is left for them. Under overload the queue holds as much work as
deadlines allow, so that every call is finished just before its deadline."""
_BATCHES_AHEAD = 2
"""Batches' worth of agents that are planned ahead of the model, so that it never waits."""
_PRIORITY_SECONDS = 60.0
"""Seconds for which a server expects that a call may have the priority that another one had."""
_SIZES = 32
"""Number of the last calls whose smallest size a new call is expected to have."""


class Call:
    """A call that was admitted: its deadline, and the queue places that it holds until its batches start."""

    def __init__(self, deadline: float) -> None:
        """
        Args:
            deadline: the time on the event loop's clock, s.
        """
        self.deadline = deadline
        """Deadline on the event loop's clock, s: the client's or the server's own, whichever is earlier."""
        self.priority = 0
        """Priority, once the request has been read; a higher one goes first."""
        self.agents = 1
        """Number of agents to forecast, once the request has been read; at least 1."""
        self.started = time.perf_counter()
        """Start of the work for the call, by ``time.perf_counter``."""
        self.helper_seconds = 0.0
        """Seconds of work for the call in helper threads."""
        self.delivered = 0.0
        """Time on the event loop's clock when its last forward was done; 0: not yet."""
        self.work = 0.0
        """Expected seconds of work for it, by its number of agents."""
        self.expected = 0.0
        """Expected seconds, without the margin, when the size was known; 0: unknown."""
        self.sized = 0.0
        """Time on the event loop's clock when the size was known."""
        self.places = 0
        """Number of queue places held."""
        self.request_id = current_request_id()
        """Id of the request, for logs; empty: there is none."""
        self.caller: str | None = None
        """Name of the caller's key; None: there is none."""
        self.grant: Grant | None = None
        """Counter of the request's agents against the limits of the key; None: there are no limits."""
        self.when_sent: list[Callable[[], None]] = []
        """Functions to call once the response has been sent."""
        self.is_trial = False
        """True if it was accepted even if it is expected to be late."""
        self.share = 0
        """Number of its agents that count as planned ahead of the model."""

    @property
    def order(self) -> Order:
        """Order in which calls are served."""
        return -self.priority, self.deadline

    def remaining(self) -> float:
        """Return the seconds until the deadline; negative after it."""
        return self.deadline - asyncio.get_running_loop().time()

    @asynccontextmanager
    async def in_time(self) -> AsyncIterator[None]:
        """Cancel the block at the deadline.

        Raises:
            DeadlineExceeded: the deadline passed.
        """
        timeout = asyncio.timeout_at(self.deadline)
        try:
            async with timeout:
                yield
        except TimeoutError:
            if not timeout.expired():
                raise
            raise DeadlineExceeded from None


class Backlog:
    """Calls that are worked on, in the order in which they are served, and the speed of the work.

    The speed tells what the costs of single calls do not: that calls share batches, and that they wait for
    the interpreter, for helper threads and for busy neighbours. By Little's law a new call takes as long as
    the work before it at that speed.
    """

    def __init__(self) -> None:
        self._calls: list[Call] = []
        self._seconds = 0.0
        self._finished = 0.0
        self._since = 0.0

    def __len__(self) -> int:
        return len(self._calls)

    def begin(self, call: Call, now: float) -> None:
        """Begin a call, whose order and work are known."""
        if not self._calls:
            self._since = now
        insort(self._calls, call, key=_order)

    def end(self, call: Call, now: float, finished: bool) -> None:
        """End a call.

        Args:
            call: the call.
            now: the time.
            finished: whether it was answered. The time of other calls counts as that of the next answer.
        """
        position = bisect_left(self._calls, call.order, key=_order)
        while self._calls[position] is not call:
            position += 1
        del self._calls[position]
        if finished:
            self._seconds = _KEPT * self._seconds + now - self._since
            self._finished = _KEPT * self._finished + call.work
            self._since = now

    def work_before(self, order: Order = (math.inf, math.inf)) -> float:
        """Return the seconds of work that are served before a new call of that order; of all by default."""
        position = bisect_right(self._calls, order, key=_order)
        return sum(call.work for call in self._calls[:position])

    def seconds(self, work: float) -> float:
        """Return the seconds in which so many seconds of work are finished; these if nothing is known."""
        return work * min(self._seconds / self._finished, _MAX_SLOWDOWN) if self._finished else work


class Margin:
    """Factor on expected times within which nearly all calls are finished.

    It is learned from how long calls took, by smoothed mean and mean deviation (Jacobson, "Congestion
    avoidance and control", 1988, section 2): where times vary little, or where expectations are too
    pessimistic, more calls are accepted.
    """

    def __init__(self) -> None:
        self._mean = 1.0
        self._deviation = _FIRST_DEVIATION

    @property
    def factor(self) -> float:
        """Factor on an expected time."""
        return min(max(self._mean + _DEVIATIONS * self._deviation, _MIN_FACTOR), _MAX_FACTOR)

    def measure(self, expected: float, seconds: float) -> None:
        """Learn from a call that took so many seconds."""
        ratio = min(seconds / expected, _MAX_FACTOR)
        error = ratio - self._mean
        self._mean += _GAIN * error
        self._deviation += _GAIN * (abs(error) - self._deviation)


class Admission:
    """Accepts and refuses calls, and gives those that were accepted their turns."""

    def __init__(self, max_batch_agents: int, max_queue_agents: int, metrics: Metrics) -> None:
        """
        Args:
            max_batch_agents: max number of agents in one forward.
            max_queue_agents: max number of agents admitted but not in the model yet.
            metrics: the metrics that count refused calls.
        """
        self.costs = CostModel()
        """Costs of forwards."""
        self.busy_until: float | None = None
        """Time on the event loop's clock when the batch in the model should be done; None: it is free."""
        self._max_batch = max_batch_agents
        self._max_queue = max_queue_agents
        self._metrics = metrics
        self._backlog = Backlog()
        self._margin = Margin()
        self._waiting = 0
        self._planned = 0
        self._turns: list[_Turn] = []
        self._sizes: deque[int] = deque(maxlen=_SIZES)
        self._tried = -math.inf
        self._top_priority = 0
        self._top_since = -math.inf

    @property
    def waiting(self) -> int:
        """Number of agents admitted but not in the model yet."""
        return self._waiting

    def admit(self, deadline: float) -> Call:
        """Admit a call on its arrival, before any work is spent on it.

        Its size and priority are not known yet: it may be as small as the smallest of the last calls, or a
        single agent if no call goes first, and as urgent as the most urgent one of the last minute.

        Args:
            deadline: the time on the event loop's clock; work that has not started by then never does.

        Raises:
            Overloaded: the queue has no room for even the smallest call, or the call would be late.
        """
        now = asyncio.get_running_loop().time()
        priority = self._top_priority if now < self._top_since + _PRIORITY_SECONDS else 0
        self._require_room(1, priority, displace=False)
        order = (-priority, deadline)
        agents = min(self._sizes, default=1) if self._backlog.work_before(order) else 1
        call = Call(deadline)
        call.is_trial = self._may_try(now)
        self._require_time(order, agents, now, call.is_trial)
        return call

    @contextmanager
    def in_progress(self, call: Call, agents: int, priority: int = 0) -> Iterator[None]:
        """Count a call as worked on, and hold queue places for its agents; those that are left at the end are
        given back.

        Args:
            call: the call.
            agents: number of agents to forecast; a call without any takes one place.
            priority: priority of the call.

        Raises:
            Overloaded: the queue has no room for so many, or they would be late.
        """
        loop = asyncio.get_running_loop()
        call.agents, call.priority, call.sized = max(agents, 1), priority, loop.time()
        self._learn(call)
        self._require_room(call.agents, priority, displace=True)
        call.work = self.costs.work(call.agents)
        call.expected = self._require_time(call.order, call.agents, call.sized, call.is_trial)
        self._backlog.begin(call, call.sized)
        call.places += call.agents
        self._count(call.agents)
        finished = False
        try:
            yield
            finished = True
        finally:
            self.release(call, call.places)
            now = loop.time()
            call.work = self.costs.seconds_of_unknown(call.agents) + call.helper_seconds
            self._backlog.end(call, now, finished)
            if finished:
                after = now - (call.delivered or now)
                self.costs.measure_around(call.agents, call.helper_seconds, after)
            if call.expected and (finished or now >= call.deadline):
                self._margin.measure(call.expected, now - call.sized)

    async def turn(self, call: Call) -> None:
        """Wait until a call may be planned: until little is planned ahead of the model.

        Args:
            call: the call, which is in progress.

        Raises:
            DeadlineExceeded: too little time is left.
            Overloaded: a call of a higher priority needed the places.
        """
        turn = _Turn(call)
        insort(self._turns, turn, key=_order)
        self._give_turns()
        begin = time.perf_counter()
        try:
            await turn.given
        finally:
            if turn in self._turns:
                self._turns.remove(turn)
        self._metrics.turn.observe(time.perf_counter() - begin)

    def release(self, call: Call, agents: int) -> None:
        """Give places of a call back; a second forward of an agent holds none."""
        agents = min(agents, call.places)
        call.places -= agents
        self._count(-agents)
        self._set_share(call, min(call.places, call.share))
        self._give_turns()

    def _learn(self, call: Call) -> None:
        """Learn which sizes and priorities calls have."""
        self._sizes.append(call.agents)
        expired = call.sized > self._top_since + _PRIORITY_SECONDS
        if call.priority and (call.priority >= self._top_priority or expired):
            self._top_priority, self._top_since = call.priority, call.sized

    def _give_turns(self) -> None:
        """Let calls begin, the first in order first, as long as there is room ahead of the model.

        A call's share of that room is at most a batch, so that others need not wait for all of a large one.
        """
        if not self._turns:
            return
        now = asyncio.get_running_loop().time()
        batch = self.costs.batch_agents(None, self._max_batch)
        while self._turns and self._planned < _BATCHES_AHEAD * batch:
            turn = self._turns.pop(0)
            call = turn.call
            if turn.given.done():
                continue
            if call.deadline < now + (0.0 if call.is_trial else self.costs.alone(call.agents)):
                self._metrics.refused.labels("dropped").inc()
                turn.given.set_exception(DeadlineExceeded())
                continue
            self._set_share(call, min(call.places, batch))
            turn.given.set_result(None)

    def _set_share(self, call: Call, share: int) -> None:
        self._planned += share - call.share
        call.share = share

    def _require_room(self, agents: int, priority: int, *, displace: bool) -> None:
        """Refuse a call if the queue has no room for it and for no call of a lower priority.

        Args:
            agents: its agents.
            priority: its priority.
            displace: whether calls of a lower priority leave the queue for it; the last in order first.

        Raises:
            Overloaded: there is no room.
        """
        missing = self._waiting + agents - self._max_queue
        if missing <= 0:
            return
        lower = [turn for turn in self._turns if turn.call.priority < priority and not turn.given.done()]
        if missing > sum(turn.call.places for turn in lower):
            self._metrics.refused.labels("queue_full").inc()
            raise Overloaded(
                f"{self._waiting} agents are queued, and at most {self._max_queue} may be",
                self._retry_after(),
            )
        while displace and missing > 0:
            turn = lower.pop()
            missing -= turn.call.places
            self._turns.remove(turn)
            self.release(turn.call, turn.call.places)
            self._metrics.refused.labels("displaced").inc()
            turn.given.set_exception(
                Overloaded("calls of a higher priority have filled the queue", self._retry_after())
            )

    def _may_try(self, now: float) -> bool:
        """Return whether a call is accepted even if it is expected to be late.

        That is so once a second while the model is free and nothing waits: otherwise a wrong expectation
        could never be corrected.
        """
        if self._backlog or self.busy_until is not None or now < self._tried + _TRIAL_SECONDS:
            return False
        self._tried = now
        return True

    def _require_time(self, order: Order, agents: int, now: float, is_trial: bool) -> float:
        """Refuse a call that would be late.

        Args:
            order: its order.
            agents: number of agents to forecast.
            now: the time.
            is_trial: whether it is accepted as long as its deadline has not passed.

        Returns:
            The expected seconds until it is answered, without the margin.

        Raises:
            Overloaded: too little time is left.
        """
        expected = self._expected(order, agents, now)
        remaining = order[1] - now
        transit = max(_TRANSIT, _TRANSIT_SHARE * remaining)
        # Where nothing goes first, a refusal would only leave the model idle: a likely success is enough
        idle = self.busy_until is None and self._waiting == 0
        margin = min(self._margin.factor, 1.0) if idle else self._margin.factor
        needed = (0.0 if is_trial else expected * margin) + transit
        if needed > remaining:
            self._metrics.refused.labels("late").inc()
            raise Overloaded(
                f"the forecast would take {needed:.2f} s, and the deadline is in {max(remaining, 0):.2f} s",
                self._retry_after(),
            )
        return expected

    def _expected(self, order: Order, agents: int, now: float) -> float:
        """Return the expected seconds until a new call is answered."""
        in_model = 0.0 if self.busy_until is None else max(self.busy_until - now, 0.0)
        if not self._backlog:  # nothing goes first, so free forwards share the call
            return self.costs.alone(agents) + in_model
        work = self.costs.work(agents)
        return max(work + in_model, self._backlog.seconds(self._backlog.work_before(order) + work))

    def _retry_after(self) -> float:
        """Return the seconds until the work that is queued now should be done."""
        return min(max(self._backlog.seconds(self._backlog.work_before()), _MIN_RETRY), _MAX_RETRY)

    def _count(self, agents: int) -> None:
        self._waiting += agents
        self._metrics.queue_agents.set(self._waiting)


class _Turn:
    """A call that waits for its turn."""

    def __init__(self, call: Call) -> None:
        self.call = call
        self.given: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    @property
    def order(self) -> Order:
        """Order of the call."""
        return self.call.order


_order = attrgetter("order")
