"""One queue in front of the model: calls that wait at the same time ride in one batch.

A batch leaves as soon as the model is free and never waits for company: under light load a call runs
alone, under heavy load batches grow by themselves. Everything here but the forward itself runs on the
event loop, so there are no locks.
"""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

import structlog
import torch

from model.forecaster import Context, Features, Forecaster, agent_count, join
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentType
from service.errors import DeadlineExceeded, Internal, Overloaded, Unavailable
from service.predict.torch_threads import set_forward_threads
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)

_T = TypeVar("_T")

_MIN_RETRY = 0.05
_MAX_RETRY = 10.0
_FIRST_RATE = 500.0
"""agents/s, a guess until the first batch was measured."""
_SMOOTHING = 0.2


@dataclass(frozen=True)
class Job:
    """Agents of one call that one forward can take."""

    forecaster: Forecaster
    agent_type: AgentType
    context: Context
    features: Features
    steps: int

    @property
    def agents(self) -> int:
        """How many."""
        return agent_count(self.features)


@dataclass(frozen=True)
class Outcome:
    """What became of a job."""

    mixture: TrajectoryMixture
    """Of the job's agents, in order."""
    queue: float
    """s from the call's acceptance until its (first) batch started."""
    inference: float
    """s in the model, of all its batches."""
    batch_agents: int
    """Agents in its (largest) batch."""


class Admission:
    """A call's place in the queue, held until its batches start."""

    def __init__(self, agents: int, accepted: float | None = None) -> None:
        """
        Args:
            agents: that hold a place.
            accepted: when the call was accepted, by ``time.perf_counter``; None: now.
        """
        self.agents = agents
        """Agents that still hold a place."""
        self.accepted = time.perf_counter() if accepted is None else accepted
        """When the call was accepted, by ``time.perf_counter``."""


@dataclass(eq=False)
class _Entry:
    """A job, or a part of one, that is small enough for a batch."""

    job: Job
    features: Features
    agents: int
    deadline: float
    admission: Admission
    queued: float
    """By ``time.perf_counter``."""
    done: "asyncio.Future[Outcome]" = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )

    @property
    def key(self) -> tuple[int, AgentType, Context]:
        """Entries of equal keys can share a forward."""
        return id(self.job.forecaster), self.job.agent_type, self.job.context


class Batcher:
    """The queue and the thread of the model."""

    def __init__(
        self, max_batch_agents: int, max_queue_agents: int, metrics: Metrics, threads: int | None = None
    ) -> None:
        """
        Args:
            max_batch_agents: agents in one forward.
            max_queue_agents: agents accepted but not in the model yet.
            metrics: where batches are counted.
            threads: threads of the forward; None: torch's choice, the physical cores.
        """
        self._max_batch = max_batch_agents
        self._max_queue = max_queue_agents
        self._metrics = metrics
        self._queue: deque[_Entry] = deque()
        self._waiting = 0
        self._rate = _FIRST_RATE
        self._wake = asyncio.Event()
        self._thread = ThreadPoolExecutor(
            1, thread_name_prefix="forward", initializer=set_forward_threads, initargs=(threads,)
        )
        self._worker: asyncio.Task[None] | None = None

    @property
    def waiting(self) -> int:
        """Agents accepted but not in the model yet."""
        return self._waiting

    def start(self) -> None:
        """Begins to take work; on the event loop that it will live on."""
        self._worker = asyncio.create_task(self._work(), name="batcher")

    async def stop(self) -> None:
        """Refuses what is still queued and waits for the batch in the model."""
        if self._worker is not None:
            self._worker.cancel()
            await asyncio.gather(self._worker, return_exceptions=True)
        while self._queue:
            entry = self._queue.popleft()
            if not entry.done.done():
                entry.done.set_exception(Unavailable("the server is stopping"))
        await asyncio.to_thread(self._thread.shutdown)

    def check(self) -> None:
        """Whether there is room for even the smallest call.

        Raises:
            Overloaded: there is none.
        """
        self._require_room(1)

    @contextmanager
    def admit(self, agents: int, accepted: float | None = None) -> Iterator[Admission]:
        """A place in the queue for a call, before any work is put into it.

        Args:
            agents: that the call wants forecast; a call of none counts as one.
            accepted: when the call was accepted, by ``time.perf_counter``; None: now.

        Raises:
            Overloaded: there is no room.
        """
        agents = max(agents, 1)
        self._require_room(agents)
        admission = Admission(agents, accepted)
        self._count(agents)
        try:
            yield admission
        finally:
            self._release(admission, admission.agents)

    async def run(self, jobs: Sequence[Job], deadline: float, admission: Admission) -> list[Outcome]:
        """Runs the jobs of one call.

        Args:
            jobs: of any forecasters and types.
            deadline: on the event loop's clock; work that has not started by then never does.
            admission: the call's; its places pass to the jobs.

        Returns:
            What became of each job, in order.

        Raises:
            DeadlineExceeded: it passed before the model was free.
            Internal: the forward failed.
            Unavailable: the server stopped first.
        """
        parts = [self._entries(job, deadline, admission) for job in jobs]
        entries = [entry for part in parts for entry in part]
        surplus = admission.agents - sum(entry.agents for entry in entries)
        if surplus > 0:  # agents that need no forward give their places back at once
            self._release(admission, surplus)
        self._queue.extend(entries)
        self._wake.set()
        try:
            for entry in entries:
                await entry.done
        except BaseException:
            self._withdraw(entries)
            raise
        return [_combine([entry.done.result() for entry in part]) for part in parts]

    async def run_in_model_thread(self, job: Job) -> None:
        """Runs a job past the queue, for warm-up."""
        await self.call_in_model_thread(_forward, job, [job.features], job.steps)

    async def call_in_model_thread(self, function: Callable[..., _T], *arguments: object) -> _T:
        """Calls a function in the forward's thread, past the queue."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, function, *arguments)

    def _entries(self, job: Job, deadline: float, admission: Admission) -> list[_Entry]:
        """The job in parts that fit a batch."""
        queued = time.perf_counter()
        entries = []
        for start in range(0, job.agents, self._max_batch):
            stop = min(start + self._max_batch, job.agents)
            whole = stop - start == job.agents
            features = job.features if whole else {name: t[start:stop] for name, t in job.features.items()}
            entries.append(_Entry(job, features, stop - start, deadline, admission, queued))
        return entries

    def _withdraw(self, entries: Sequence[_Entry]) -> None:
        """Takes a call's entries out of the queue, whatever state they are in."""
        for entry in entries:
            if entry in self._queue:
                self._queue.remove(entry)
            if not entry.done.cancel() and not entry.done.cancelled():
                entry.done.exception()  # looked at, or asyncio would complain that nobody did

    async def _work(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            await self._wake.wait()
            batch = self._take_batch()
            if not batch:
                if not self._queue:
                    self._wake.clear()
                continue
            started = time.perf_counter()
            job = batch[0].job
            steps = max(entry.job.steps for entry in batch)
            parts = [entry.features for entry in batch]
            running = loop.run_in_executor(self._thread, _forward, job, parts, steps)
            try:
                mixture, seconds = await asyncio.shield(running)
            except asyncio.CancelledError:  # the batcher stops; the batch it has taken is finished first
                await asyncio.wait([running])
                self._fail(batch, Unavailable("the server is stopping"))
                raise
            except Exception:
                _log.exception(
                    "forward failed", model=job.forecaster.info.name, agents=sum(e.agents for e in batch)
                )
                self._fail(batch, Internal())
                continue
            self._measure(batch, started, seconds)
            self._deliver(batch, mixture, started, seconds)

    def _take_batch(self) -> list[_Entry]:
        """The oldest entry and all that can ride with it, in order; expired ones are dropped."""
        now = asyncio.get_running_loop().time()
        batch: list[_Entry] = []
        rest: deque[_Entry] = deque()
        agents, full = 0, False
        for entry in self._queue:
            if entry.done.done():
                continue
            if entry.deadline <= now:
                entry.done.set_exception(DeadlineExceeded("the deadline passed while the call was queued"))
            elif (batch and entry.key != batch[0].key) or full:
                rest.append(entry)
            elif agents + entry.agents > self._max_batch:
                full = True  # nothing younger overtakes it
                rest.append(entry)
            else:
                batch.append(entry)
                agents += entry.agents
        self._queue = rest
        for entry in batch:
            self._release(entry.admission, entry.agents)
        return batch

    def _deliver(
        self, batch: Sequence[_Entry], mixture: TrajectoryMixture, started: float, seconds: float
    ) -> None:
        agents = len(mixture)
        position = 0
        for entry in batch:
            part = mixture[position : position + entry.agents]
            position += entry.agents
            if not entry.done.done():
                queue = started - entry.admission.accepted
                outcome = Outcome(_cut(part, entry.job.steps), queue, seconds, agents)
                entry.done.set_result(outcome)

    def _fail(self, batch: Sequence[_Entry], error: Internal | Unavailable) -> None:
        for entry in batch:
            if not entry.done.done():
                entry.done.set_exception(type(error)(error.detail))

    def _measure(self, batch: Sequence[_Entry], started: float, seconds: float) -> None:
        agents = sum(entry.agents for entry in batch)
        rate = agents / max(seconds, 1e-6)
        self._rate += _SMOOTHING * (rate - self._rate)
        self._metrics.batch_agents.observe(agents)
        self._metrics.inference.labels(batch[0].job.forecaster.info.name).observe(seconds)
        for entry in batch:
            self._metrics.queue.observe(started - entry.queued)

    def _require_room(self, agents: int) -> None:
        if self._waiting + agents > self._max_queue:
            raise Overloaded(
                f"{self._waiting} agents are queued, and at most {self._max_queue} may be",
                self._retry_after(),
            )

    def _retry_after(self) -> float:
        """s until what is queued now should be through."""
        return min(max(self._waiting / self._rate, _MIN_RETRY), _MAX_RETRY)

    def _count(self, agents: int) -> None:
        self._waiting += agents
        self._metrics.queue_agents.set(self._waiting)

    def _release(self, admission: Admission, agents: int) -> None:
        """Gives places back; work beyond what was admitted (a second forward) holds none."""
        agents = min(agents, admission.agents)
        admission.agents -= agents
        self._count(-agents)


def _forward(job: Job, parts: Sequence[Features], steps: int) -> tuple[TrajectoryMixture, float]:
    """One forward of the job's forecaster over the joined parts, and the seconds it took."""
    started = time.perf_counter()
    with torch.inference_mode():
        features = join(parts)
        mixture = job.forecaster.forecast(features, job.agent_type, job.context, steps)
    expected = agent_count(features)
    if len(mixture) != expected:
        raise RuntimeError(f"{job.forecaster.info.name} made {len(mixture)} forecasts of {expected} agents")
    return mixture, time.perf_counter() - started


def _cut(mixture: TrajectoryMixture, steps: int) -> TrajectoryMixture:
    if mixture.means.shape[2] == steps:
        return mixture
    return TrajectoryMixture(
        mixture.log_weights, mixture.means[:, :, :steps], mixture.covariances[:, :, :steps], mixture.origin
    )


def _combine(outcomes: Sequence[Outcome]) -> Outcome:
    """The parts of a split job as one."""
    if len(outcomes) == 1:
        return outcomes[0]
    mixtures = [outcome.mixture for outcome in outcomes]
    mixture = TrajectoryMixture(
        torch.cat([m.log_weights for m in mixtures]),
        torch.cat([m.means for m in mixtures]),
        torch.cat([m.covariances for m in mixtures]),
        torch.cat([m.origin for m in mixtures]),
    )
    return Outcome(
        mixture,
        min(outcome.queue for outcome in outcomes),
        sum(outcome.inference for outcome in outcomes),
        max(outcome.batch_agents for outcome in outcomes),
    )
