"""Dynamic batching: calls that wait for the model at the same time share a forward.

A batch starts as soon as a forward may and never waits for more calls: under light load a call runs alone,
under heavy load batches grow by themselves. The most urgent work goes first (``service.predict.scheduler``).
Several forwards run at the same time and share the cores; where nothing else waits, the agents of a call are
spread over them. Everything except the forward runs on the event loop, so there are no locks.
"""

import asyncio
import math
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TypeVar

import structlog
import torch

from model.forecaster import Context, Forecaster, Prepared
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentType
from service.errors import DeadlineExceeded, Internal, Unavailable
from service.predict.admission import Admission, Call
from service.predict.forward import Batch, Forwarded, forward
from service.predict.scheduler import DeadlineQueue
from service.predict.torch_threads import ONE_FORWARD, ForwardThreads, make_cutters
from service.predict.workers import Worker
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)

_T = TypeVar("_T")

_MANY_AGENTS = 16
"""Agents in the queue from which on a forward starts beside another one in any case."""
_AHEAD_SECONDS = 0.015
"""Seconds before the end of a forward from which on its thread is given the next batch: the event loop may be
busy for as long when it ends."""
_SPARE_SECONDS = 0.01
"""Seconds that a forward outside the queue may be expected to take."""
_POLL = 0.002
"""Seconds between looks at whether the model is free."""


@dataclass(frozen=True)
class Job:
    """Agents of one call that can share a forward."""

    forecaster: Forecaster
    agent_type: AgentType
    context: Context
    inputs: Prepared
    steps: int

    @property
    def agents(self) -> int:
        """Number of agents."""
        return len(self.inputs)

    @property
    def key(self) -> tuple[int, AgentType, Context]:
        """Key of the jobs that can share a forward."""
        return id(self.forecaster), self.agent_type, self.context


@dataclass(frozen=True)
class Outcome:
    """Result of a job."""

    mixture: TrajectoryMixture
    """Forecasts of the job's agents, in order."""
    queue: float
    """Seconds from the start of the call until its (first) batch started; of a job that ran past the queue,
    when that was by ``time.perf_counter``."""
    inference: float
    """Seconds in the model: see ``seconds_in_model``."""
    batch_agents: int
    """Number of agents in its (largest) batch."""
    patches: float = 0.0
    """Seconds of ``inference`` before the network began, in which map patches were cut."""


@dataclass(eq=False)
class _Entry:
    """A job, or a part of one, that fits a batch."""

    job: Job
    inputs: Prepared
    agents: int
    call: Call
    queued: float
    """Time by ``time.perf_counter``."""
    done: "asyncio.Future[Outcome]" = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )

    @property
    def key(self) -> tuple[int, AgentType, Context]:
        """Key of the entries that can share a forward."""
        return self.job.key

    @property
    def deadline(self) -> float:
        """Deadline of the call, on the event loop's clock, s."""
        return self.call.deadline

    @property
    def priority(self) -> int:
        """Priority of the call."""
        return self.call.priority

    @property
    def finished(self) -> bool:
        """True if the entry has been cancelled or has failed meanwhile."""
        return self.done.done()


@dataclass(eq=False)
class _Batch:
    """Entries that share a forward, in the model or about to be."""

    entries: list[_Entry]
    since: float
    """Time when it was given to its thread, by ``time.perf_counter``."""
    until: float
    """Time on the event loop's clock when it should be done."""
    task: "asyncio.Task[None] | None" = None

    @property
    def agents(self) -> int:
        """Number of agents."""
        return sum(entry.agents for entry in self.entries)


class _Slot:
    """Thread of forwards, and the batches that it was given: the one in the model, and perhaps the next."""

    def __init__(self, number: int, width: int, worker: Worker | None = None) -> None:
        self.thread = ThreadPoolExecutor(
            1,
            thread_name_prefix=f"forward-{number}",
            initializer=torch.set_num_threads,
            initargs=(width,),
        )
        self.worker = worker
        """Process in which the thread has forwards run; None: it runs them itself."""
        self.batches: list[_Batch] = []

    def forward(
        self, job: Job, parts: Sequence[Prepared], steps: int, cutters: Executor | None
    ) -> "asyncio.Future[Forwarded]":
        """Give a forward to the thread."""
        run = forward if self.worker is None else self.worker.forward
        batch = Batch(job.agent_type, job.context, parts, steps)
        return asyncio.get_running_loop().run_in_executor(self.thread, run, job.forecaster, batch, cutters)

    @property
    def until(self) -> float:
        """Time on the event loop's clock when all its batches should be done; 0 while it is free."""
        return self.batches[-1].until if self.batches else 0.0


class Batcher:
    """Queue of jobs and threads of the forward."""

    def __init__(
        self,
        max_batch_agents: int,
        admission: Admission,
        metrics: Metrics,
        threads: ForwardThreads = ONE_FORWARD,
    ) -> None:
        """
        Args:
            max_batch_agents: max number of agents in one forward.
            admission: admits the calls whose jobs are queued.
            metrics: the metrics that count batches.
            threads: numbers of forwards at the same time, of their threads, and of processes that run them.
        """
        self._max_batch = max_batch_agents
        self._admission = admission
        self._metrics = metrics
        self._costs = admission.costs
        self._costs.forwards = min(threads.forwards, threads.total)
        self._queue: DeadlineQueue[_Entry] = DeadlineQueue(self._costs)
        self._wake = asyncio.Event()
        self._workers = [
            Worker(number, threads.width, metrics.worker_deaths.inc) for number in range(threads.workers)
        ]
        self._slots = [
            _Slot(number, threads.width, self._workers[number] if self._workers else None)
            for number in range(threads.forwards)
        ]
        metrics.workers.set_function(lambda: sum(worker.is_ready for worker in self._workers))
        self._cutters = make_cutters(threads.width)
        self._worker: asyncio.Task[None] | None = None
        self._crashed = False
        self._on_crash: Callable[[], None] | None = None

    @property
    def forward_seconds(self) -> float:
        """Seconds since the oldest batch in the model started; 0 while the model is free."""
        now = time.perf_counter()
        return max((now - batch.since for batch in self._batches), default=0.0)

    def start(self, on_crash: Callable[[], None] | None = None) -> None:
        """Start the worker on the running event loop.

        Args:
            on_crash: called if the worker ends by an exception, after its calls have failed.
        """
        self._on_crash = on_crash
        self._worker = asyncio.create_task(self._work(), name="batcher")
        self._worker.add_done_callback(self._check)

    def start_workers(self, forecasters: Sequence[Forecaster], default: Forecaster) -> None:
        """Begin to start the processes, if there are any; until they have loaded the models, threads do.

        Args:
            forecasters: the models.
            default: the one that most calls use.
        """
        for worker in self._workers:
            worker.start(forecasters, default, self._max_batch)

    async def stop(self) -> None:
        """Fail the queued jobs, and wait for the batches that are in the model."""
        tasks = [task for task in (self._worker, *(batch.task for batch in self._batches)) if task]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._fail(self._queue, Unavailable("the server is stopping"))
        self._queue.clear()
        for slot in self._slots:
            await asyncio.to_thread(slot.thread.shutdown)
        for worker in self._workers:
            await asyncio.to_thread(worker.close)
        if self._cutters is not None:
            self._cutters.shutdown()

    async def run(self, jobs: Sequence[Job], call: Call) -> list[Outcome]:
        """Run the jobs of a call, of any forecasters and types.

        Args:
            jobs: the jobs.
            call: the call, whose places pass to the jobs.

        Returns:
            The result of each job, in order.

        Raises:
            DeadlineExceeded: the deadline passed before the model was free.
            Internal: the forward failed.
            Unavailable: the server stopped first.
        """
        if self._crashed:
            raise Internal()
        parts = [self._entries(job, call) for job in jobs]
        entries = [entry for part in parts for entry in part]
        surplus = call.places - sum(entry.agents for entry in entries)
        if surplus > 0:  # agents that need no forward give their places back at once
            self._admission.release(call, surplus)
        for part in parts:
            lag = 0.0
            for entry in part:
                self._queue.put(entry, lag)
                lag += self._costs.seconds(entry.key, entry.agents)
        self._wake.set()
        try:
            await asyncio.gather(*(entry.done for entry in entries))
        except BaseException:
            self._withdraw(entries)
            raise
        call.delivered = asyncio.get_running_loop().time()
        return [combine([entry.done.result() for entry in part]) for part in parts]

    async def run_in_model_threads(self, job: Job) -> float:
        """Run a job past the queue in each process of the forward, for warm-up, and learn its duration.

        Returns:
            The seconds of the slowest forward.
        """
        # Threads share what a forward allocates and compiles; processes do not
        apart = [slot for slot in self._slots if slot.worker is not None and slot.worker.is_ready]
        return max([(await self._run_alone(job, slot)).inference for slot in apart or self._slots[:1]])

    @property
    def is_free(self) -> bool:
        """True if no call waits for the model or is in it."""
        return not (self._batches or self._admission.waiting or self._queue)

    async def until_free(self, until: float = math.inf) -> bool:
        """Wait until no call waits for the model or is in it, and return True.

        Args:
            until: time on the event loop's clock at which the wait ends, and the result is False.
        """
        loop = asyncio.get_running_loop()
        while not self.is_free:
            if loop.time() > until:
                return False
            await asyncio.sleep(_POLL)
        return True

    def spare_parts(self, job: Job) -> list[Job]:
        """Return a job in parts so small that calls which arrive meanwhile hardly wait, for ``run_spare``."""
        size = job.agents
        while size > 1 and self._costs.seconds(job.key, size) > _SPARE_SECONDS:
            size //= 2
        return [replace(job, inputs=job.inputs[start : start + size]) for start in range(0, job.agents, size)]

    async def run_spare(self, job: Job) -> Outcome:
        """Run a job past the queue. The caller waits until ``is_free``, and counts the work."""
        return await self._run_alone(job, self._slots[-1], usual=False)

    async def _run_alone(self, job: Job, slot: _Slot, usual: bool = True) -> Outcome:
        done = await slot.forward(job, [job.inputs], job.steps, self._cutters)
        self._costs.measure(job.key, job.agents, done.seconds, usual=usual)
        return Outcome(done.mixture, done.started, done.seconds, job.agents, done.patches)

    def forget(self, forecasters: Iterable[Forecaster]) -> None:
        """Forget models that are gone, and how long their forwards take."""
        gone = {id(forecaster) for forecaster in forecasters}
        self._costs.forget(gone)
        for slot in self._slots:
            if slot.worker is not None:
                slot.thread.submit(slot.worker.forget, gone)

    async def call_in_model_thread(self, function: Callable[..., _T], *arguments: object) -> _T:
        """Call a function in a thread of the forward, past the queue."""
        return await asyncio.get_running_loop().run_in_executor(self._slots[0].thread, function, *arguments)

    def _entries(self, job: Job, call: Call) -> list[_Entry]:
        """Return the job in parts that fit a batch, and that the free forwards share if nothing waits."""
        queued = time.perf_counter()
        entries = []
        size = self._costs.batch_agents(job.key, self._max_batch)
        share = self._costs.share(job.key, job.agents, 0 if self._queue else len(self._idle))
        # If its parts were late, all but one would be dropped, and nothing would be learned of the whole
        if call.remaining() > self._costs.seconds(job.key, share) + self._costs.after:
            size = min(size, share)
        for start in range(0, job.agents, size):
            stop = min(start + size, job.agents)
            whole = stop - start == job.agents
            inputs = job.inputs if whole else job.inputs[start:stop]
            entries.append(_Entry(job, inputs, stop - start, call, queued))
        return entries

    def _withdraw(self, entries: Sequence[_Entry]) -> None:
        """Remove a call's entries from the queue, in whatever state they are."""
        for entry in entries:
            self._queue.remove(entry)
            if not entry.done.cancel() and not entry.done.cancelled():
                entry.done.exception()  # retrieved, or asyncio would log that it never was

    @property
    def _batches(self) -> list[_Batch]:
        return [batch for slot in self._slots for batch in slot.batches]

    @property
    def _idle(self) -> list[_Slot]:
        return [slot for slot in self._slots if not slot.batches]

    async def _work(self) -> None:
        """Give batches to slots as long as work is queued and a slot is free or about to be."""
        loop = asyncio.get_running_loop()
        timer: asyncio.TimerHandle | None = None
        while True:
            await self._wake.wait()
            self._wake.clear()
            if timer is not None:
                timer.cancel()
            while self._queue and (slots := self._free_slots()):
                share = self._costs.share(next(iter(self._queue)).key, self._queue.agents, len(slots))
                for slot in slots:
                    entries = self._take_batch(max(loop.time(), slot.until), share)
                    if entries:
                        self._start(slot, entries)
            first = self._first_busy()
            if self._queue and first is not None and first.until - _AHEAD_SECONDS > loop.time():
                timer = loop.call_at(first.until - _AHEAD_SECONDS, self._wake.set)
            # Behind that time nothing changes until work comes or a forward ends, and both wake this task

    def _free_slots(self) -> list[_Slot]:
        """Return the slots for the next batches; none: they wait.

        A forward of a few agents beside another one, or right behind it, only starts if it ends before the
        other: at the end of that more of them will have come, and a shared forward takes less time than two.
        """
        idle, first = self._idle, self._first_busy()
        if first is None:
            return idle
        now = asyncio.get_running_loop().time()
        if self._queue.agents >= min(_MANY_AGENTS, self._max_batch):
            ahead = len(first.batches) == 1 and now >= first.until - _AHEAD_SECONDS
            return idle or ([first] if ahead else [])
        entry = next(iter(self._queue))
        return idle[:1] if now + self._costs.seconds(entry.key, entry.agents) < first.until else []

    def _first_busy(self) -> _Slot | None:
        """Return the busy slot that needs its next batch first; None: all are free."""
        busy = (slot for slot in self._slots if slot.batches)
        return min(busy, key=lambda slot: (len(slot.batches), slot.until), default=None)

    def _start(self, slot: _Slot, entries: list[_Entry]) -> None:
        """Give a batch to a slot."""
        loop = asyncio.get_running_loop()
        batch = _Batch(entries, time.perf_counter(), max(loop.time(), slot.until))
        batch.until += self._costs.seconds(entries[0].key, batch.agents)
        slot.batches.append(batch)
        self._tell_admission()
        job = entries[0].job
        steps = max(entry.job.steps for entry in entries)
        parts = [entry.inputs for entry in entries]
        # Not in the task, which begins only after all that the event loop has to do now
        running = slot.forward(job, parts, steps, self._cutters)
        batch.task = asyncio.create_task(self._finish(slot, batch, running), name="forward")
        batch.task.add_done_callback(self._check)

    def _tell_admission(self) -> None:
        """Tell the admission when a slot should be free."""
        ends = [slot.until for slot in self._slots]
        self._admission.busy_until = min(ends) or None

    async def _finish(self, slot: _Slot, batch: _Batch, running: "asyncio.Future[Forwarded]") -> None:
        """Deliver a batch once its forward is done."""
        try:
            done = await asyncio.shield(running)
        except asyncio.CancelledError:  # the batcher stops; a batch that has started is finished first
            await asyncio.wait([running])
            self._fail(batch.entries, Unavailable("the server is stopping"))
            raise
        except Exception:
            _log.exception(
                "forward failed",
                model=batch.entries[0].job.forecaster.info.name,
                agents=batch.agents,
                request_ids=sorted({entry.call.request_id for entry in batch.entries}),
            )
            self._fail(batch.entries, Internal())
        else:
            self._measure(batch, done)
            self._deliver(batch.entries, done)
        if self._crashed:  # the slots have been cleared
            return
        slot.batches.remove(batch)
        self._tell_admission()
        self._wake.set()

    def _check(self, worker: "asyncio.Task[None]") -> None:
        """Fail all calls if a task has crashed: without it nothing would ever be answered."""
        if worker.cancelled() or worker.exception() is None:
            return
        _log.critical("batcher crashed", exc_info=worker.exception())
        self._crashed = True
        for slot in self._slots:
            for batch in slot.batches:
                self._fail(batch.entries, Internal())
            slot.batches = []
        self._fail(self._queue, Internal())
        self._queue.clear()
        if self._on_crash is not None:
            self._on_crash()

    def _take_batch(self, start: float, share: int) -> list[_Entry]:
        """Take the most urgent batch, and fail the entries that would be late.

        Args:
            start: time on the event loop's clock when its forward can start.
            share: number of agents after which the rest is for other forwards.
        """
        batch, late, departure = self._queue.take_batch(start, self._max_batch, share)
        for entry in late:
            self._metrics.refused.labels("dropped").inc()
            entry.done.set_exception(DeadlineExceeded())
        if batch:
            self._metrics.batches.labels(departure.value).inc()
        for entry in batch:
            self._admission.release(entry.call, entry.agents)
        return batch

    def _deliver(self, batch: Sequence[_Entry], done: Forwarded) -> None:
        agents = len(done.mixture)
        position = 0
        for entry in batch:
            part = done.mixture[position : position + entry.agents]
            position += entry.agents
            if not entry.done.done():
                queue = done.started - entry.call.started
                part = _cut(part, entry.job.steps)
                entry.done.set_result(Outcome(part, queue, done.seconds, agents, done.patches))

    def _fail(self, entries: Iterable[_Entry], error: Internal | Unavailable) -> None:
        for entry in entries:
            if not entry.done.done():
                entry.done.set_exception(type(error)(error.detail))

    def _measure(self, batch: _Batch, done: Forwarded) -> None:
        first = batch.entries[0]
        self._costs.measure(first.key, batch.agents, done.seconds)
        self._metrics.batch_agents.observe(batch.agents)
        self._metrics.inference.labels(first.job.forecaster.info.name).observe(done.seconds)
        for entry in batch.entries:
            self._metrics.queue.observe(done.started - entry.queued)


def _cut(mixture: TrajectoryMixture, steps: int) -> TrajectoryMixture:
    if mixture.means.shape[2] == steps:
        return mixture
    return TrajectoryMixture(
        mixture.log_weights, mixture.means[:, :, :steps], mixture.covariances[:, :, :steps], mixture.origin
    )


def combine(outcomes: Sequence[Outcome]) -> Outcome:
    """Return the outcome of a job from those of its parts."""
    if len(outcomes) == 1:
        return outcomes[0]
    mixtures = [outcome.mixture for outcome in outcomes]
    inference = seconds_in_model(outcomes)
    cut = sum(outcome.patches for outcome in outcomes) / sum(outcome.inference for outcome in outcomes)
    mixture = TrajectoryMixture(
        torch.cat([m.log_weights for m in mixtures]),
        torch.cat([m.means for m in mixtures]),
        torch.cat([m.covariances for m in mixtures]),
        torch.cat([m.origin for m in mixtures]),
    )
    return Outcome(
        mixture,
        min(outcome.queue for outcome in outcomes),
        inference,
        max(outcome.batch_agents for outcome in outcomes),
        cut * inference,
    )


def seconds_in_model(outcomes: Iterable[Outcome]) -> float:
    """Return the seconds in which at least one of the batches was in the model."""
    seconds, until = 0.0, -math.inf
    for start, duration in sorted((outcome.queue, outcome.inference) for outcome in outcomes):
        seconds += max(start + duration - max(start, until), 0.0)
        until = max(until, start + duration)
    return seconds
