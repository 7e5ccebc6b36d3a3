"""Load on a fixed schedule (open loop) or by a fixed number of clients (closed loop).

In an open loop calls are sent when the schedule says so, whatever becomes of earlier ones, and latencies
count from the scheduled time. A slow server can therefore not hide its queue by slowing its clients down
("coordinated omission").
"""

import asyncio
import random
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loadtest.requests import Request
from loadtest.wire import Wire
from model.arrays import Floats

SAMPLED = 24
"""Max number of answers of a run that are kept to be checked."""

_FIRST_BACKOFF = 0.05
_MAX_BACKOFF = 0.5
_MIN_TIMEOUT = 1e-3
_UNKNOWN_RASTER = "FAILED_PRECONDITION"
_RETRIED = ("UNAVAILABLE", "RESOURCE_EXHAUSTED")


@dataclass(slots=True)
class Call:
    """One call; times are seconds since the start of the run."""

    request: int
    """Number of the request."""
    scheduled: float
    sent: float
    done: float = 0.0
    code: str = "LOST"
    """Canonical status code; CANCELLED if the client cancelled it."""
    body: bytes = b""
    """Answer, of a sample of the calls."""

    @property
    def seconds(self) -> float:
        """Latency from the scheduled time, s."""
        return self.done - self.scheduled


@dataclass(frozen=True)
class Load:
    """Calls on a schedule."""

    arrivals: Floats
    """Scheduled times, ascending, s since the start."""
    seconds: float
    """Duration of the schedule."""
    deadline: float | None = None
    """Seconds from the scheduled time; None: none."""
    cancelled: float = 0.0
    """Share of the calls that the client cancels."""
    cancel_within: float = 0.1
    """Max seconds after which it cancels them."""
    retry_for: float = 0.0
    """Seconds from the scheduled time for which refused and failed calls are sent again."""


@dataclass(frozen=True)
class Calls:
    """Finished calls of a run."""

    load: Load
    all: list[Call]
    seconds: float
    """Time from the start until the last call was done."""
    cpu: float
    """Share of one core that this process used."""


def even(rate: float, seconds: float, start: float = 0.0) -> Floats:
    """Return the times of calls at even intervals."""
    return start + np.arange(round(rate * seconds)) / rate


def poisson(rate: float, seconds: float, start: float = 0.0, seed: int = 0) -> Floats:
    """Return the times of a Poisson process with the expected number of calls.

    Given their number, the times of a Poisson process are independent and uniform.
    """
    return start + np.sort(np.random.default_rng(seed).uniform(0, seconds, round(rate * seconds)))


def _timeout(time_left: float | None) -> float | None:
    return None if time_left is None else max(time_left, _MIN_TIMEOUT)


class Generator:
    """Generator of load over one connection, in the event loop of this process.

    Args:
        wire: the connection.
        requests: the requests, used in turn.
    """

    def __init__(self, wire: Wire, requests: Sequence[Request]) -> None:
        self._wire = wire
        self._requests = requests
        self._random = random.Random(0)  # noqa: S311 - for samples and jitter

    async def open_loop(self, load: Load) -> Calls:
        """Send the calls of a load when they are due, and wait until all are done."""
        run = _Run(self._wire, self._requests, load, self._random)
        async with asyncio.TaskGroup() as group:
            for number, due in enumerate(load.arrivals.tolist()):
                # Also with a delay of 0, so that earlier calls are sent first
                await asyncio.sleep(max(due - run.now(), 0))
                group.create_task(run.scheduled(run.add(number, due)))
            await asyncio.sleep(max(load.seconds - run.now(), 0))
        return run.finish()

    async def closed_loop(self, clients: int, seconds: float) -> Calls:
        """Let each client send a call whenever its last one is done.

        Args:
            clients: number of concurrent calls.
            seconds: time in which calls are started; each client sends at least one.
        """
        run = _Run(self._wire, self._requests, Load(np.zeros(0), seconds), self._random)

        async def client(first: int) -> None:
            number = first
            while True:
                await run.once(run.add(number, run.now()), None)
                number += clients
                if run.now() >= seconds:
                    break

        async with asyncio.TaskGroup() as group:
            for first in range(clients):
                group.create_task(client(first))
        return run.finish()


class _Run:
    """One run of a generator."""

    def __init__(self, wire: Wire, requests: Sequence[Request], load: Load, chance: random.Random) -> None:
        self._wire = wire
        self._requests = requests
        self._load = load
        self._random = chance
        self._calls: list[Call] = []
        self._sample: list[Call] = []
        self._answers = 0
        self._cpu = time.process_time()
        self._begin = time.perf_counter()

    def now(self) -> float:
        """Return the seconds since the start."""
        return time.perf_counter() - self._begin

    def add(self, number: int, due: float) -> Call:
        """Return a new call that is to be sent now."""
        call = Call(number % len(self._requests), due, self.now())
        self._calls.append(call)
        return call

    def finish(self) -> Calls:
        """Return the calls, which are done."""
        seconds = self.now()
        return Calls(self._load, self._calls, seconds, (time.process_time() - self._cpu) / seconds)

    async def scheduled(self, call: Call) -> None:
        """Send a call, again if it may be retried, or cancel it."""
        load = self._load
        if self._random.random() < load.cancelled:
            try:
                async with asyncio.timeout(self._random.uniform(0, load.cancel_within)):
                    await self.once(call, load.deadline)
            except TimeoutError:
                call.code, call.done = "CANCELLED", self.now()
            return
        deadline = None if load.deadline is None else call.scheduled + load.deadline - self.now()
        backoff = _FIRST_BACKOFF
        while True:
            await self.once(call, deadline)
            if call.code not in _RETRIED or self.now() + backoff > call.scheduled + load.retry_for:
                return
            await asyncio.sleep(backoff * self._random.uniform(0.5, 1.0))
            backoff = min(2 * backoff, _MAX_BACKOFF)
            deadline = load.deadline  # each attempt has its own

    async def once(self, call: Call, time_left: float | None) -> None:
        """Send a call once."""
        request = self._requests[call.request]
        begin = self.now()
        reply = await self._wire.call(request.body, _timeout(time_left))
        if reply.code == _UNKNOWN_RASTER and request.whole:
            left = None if time_left is None else time_left - (self.now() - begin)
            reply = await self._wire.call(request.whole, _timeout(left))
        call.done, call.code = self.now(), reply.code
        if reply.code == "OK":
            self._keep(call, reply.body)

    def _keep(self, call: Call, body: bytes) -> None:
        """Keep a uniform sample of the answers (reservoir sampling)."""
        self._answers += 1
        if len(self._sample) < SAMPLED:
            self._sample.append(call)
        elif (place := self._random.randrange(self._answers)) < SAMPLED:
            self._sample[place].body = b""
            self._sample[place] = call
        else:
            return
        call.body = body
