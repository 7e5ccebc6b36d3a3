"""A call from request message to answer message; the transports only carry them."""

import asyncio
import os
import secrets
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import structlog
import torch

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.forecaster import Forecaster
from model.scenes.resample import history_seconds
from service.errors import BadField, DeadlineExceeded, Fault, Unavailable
from service.lifecycle import Lifecycle, Phase
from service.predict.batcher import Admission, Batcher, Outcome
from service.predict.catalog import Catalog, Models, build_catalog, reference
from service.predict.encode import Result, encode, finite
from service.predict.off_road import count_off_road
from service.predict.plan import Draft, Group, Plan, check_strict, fall_back, frames_of, make_plan
from service.predict.request import Agents, Options, read_agents, read_options
from service.predict.request_reader import EncodedRequest, RequestReader
from service.predict.torch_threads import set_helper_threads
from service.predict.track_updates import observed, report, sightings, with_histories
from service.predict.warmup import warm_up
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.tracking.collector import ConsistencyCollector, StoreMetrics
from service.tracking.model_references import ModelReferences
from service.tracking.service import ConsistencyService
from service.tracking.store.base import TrackUpdate
from service.tracking.store.factory import make_store
from service.tracking.store.guard import Guard
from service.tracking.tracker import Tracker, TrackingResult

_log = structlog.get_logger(__name__)

_T = TypeVar("_T")
_MAX_WORKERS = 8
_RESERVE = 0.005
"""s before a call's deadline at which it no longer waits for the track memory."""


@dataclass(frozen=True)
class Call:
    """A call that was accepted."""

    deadline: float
    """On the event loop's clock, s; the client's or the server's own, whichever is earlier."""
    catalog: Catalog
    """The models that there are for it."""

    def left(self) -> float:
        """s until the deadline; negative after it."""
        return self.deadline - asyncio.get_running_loop().time()

    @asynccontextmanager
    async def in_time(self) -> AsyncIterator[None]:
        """Cuts off at the deadline what is done for the call within this.

        Raises:
            DeadlineExceeded: it passed.
        """
        timeout = asyncio.timeout_at(self.deadline)
        try:
            async with timeout:
                yield
        except TimeoutError:
            if not timeout.expired():
                raise
            raise DeadlineExceeded("the deadline passed before a forecast was made") from None


class DataPlane:
    """The service itself. Lives on one event loop; decoding, encoding and the model have threads."""

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self._settings = settings
        self._metrics = metrics
        self._catalog: Catalog | None = None
        self._lifecycle = Lifecycle()
        self._references = ModelReferences()
        self._batcher = Batcher(
            settings.max_batch_agents, settings.max_queue_agents, metrics, threads=settings.threads
        )
        self._threads = ThreadPoolExecutor(
            min(_MAX_WORKERS, (os.cpu_count() or 1) + 1),
            thread_name_prefix="calls",
            initializer=set_helper_threads,
        )
        self._reader = RequestReader(self._threads)
        self._store = make_store(settings)
        store_metrics = StoreMetrics(metrics.registry)
        self._guard = Guard(store_metrics.observe, store_metrics.failed)
        # Of its own: those who ask for much, and wait for it, must not open the circuit of the forecasts
        self._asking = Guard(store_metrics.observe, store_metrics.failed)
        self._tracker = Tracker(
            self._store, self._guard, self._asking, settings.store_budget_ms / 1000, self._references
        )
        metrics.registry.register(ConsistencyCollector(self._tracker.aggregates))
        self.consistency = ConsistencyService(
            self._store, self._asking, self._tracker, self._references, self._lifecycle
        )
        """The calls about consistency."""

    @property
    def phase(self) -> Phase:
        """Where this server is in its life."""
        return self._lifecycle.phase

    async def open(self, load: Callable[[], Models]) -> None:
        """Loads and warms up; calls are taken from then on.

        Args:
            load: gives the models; runs in a thread.

        Raises:
            SettingsError: a model that is needed is not there.
            Exception: whatever ``load`` raises.
        """
        models = await self._in_thread(load)
        catalog = build_catalog(models, self._settings.default_model)
        self._batcher.start()
        await warm_up(self._batcher, catalog, self._settings.max_batch_agents)
        self._metrics.set_models(models.infos(), catalog.default.info)
        self._catalog = catalog
        self._references.set_loaded(reference(info) for info in models.infos())
        self._lifecycle.set_ready()

    def refuse(self) -> None:
        """No more calls; those accepted go on, but for those that watch."""
        self._lifecycle.refuse()
        self.consistency.end_watching()

    async def drain(self, seconds: float) -> bool:
        """Waits until the answers of all accepted calls are out, so long at most; whether they are."""
        self.refuse()
        idle = await self._lifecycle.wait_idle(seconds)
        if not idle:
            _log.warning("calls left unanswered", calls=self._lifecycle.calls)
        return idle

    async def close(self) -> None:
        """Stops the threads."""
        self.refuse()
        await self._batcher.stop()
        await self._guard.close()
        await self._asking.close()
        await self._store.close()
        await asyncio.to_thread(self._threads.shutdown, cancel_futures=True)

    @contextmanager
    def accept(self, timeout: float | None = None) -> Iterator[Call]:
        """Takes a call in as it arrives, before any work goes into it. A drain waits for it until this is
        left, which a transport does when the answer is out.

        Args:
            timeout: s that the client gives; the server's own limit holds as well.

        Raises:
            Unavailable: not ready.
            Overloaded: the queue is full.
        """
        catalog = self._require_ready()
        self._batcher.check()
        limit = self._settings.max_timeout
        seconds = limit if timeout is None else min(timeout, limit)
        with self._lifecycle.in_progress():
            yield Call(asyncio.get_running_loop().time() + seconds, catalog)

    async def predict(
        self, request: pb.PredictRequest | EncodedRequest, call: Call | None = None
    ) -> pb.PredictResponse:
        """Forecasts the agents of a scene. Cancelling the call takes it out of the queue.

        Args:
            request: as it came.
            call: that it came with; None: it is accepted here.

        Raises:
            ServiceError: whatever row of the table applies.
        """
        if call is None:
            with self.accept() as own:
                return await self.predict(request, own)
        accepted = time.perf_counter()
        async with call.in_time():
            message = await self._reader.read(request) if isinstance(request, EncodedRequest) else request
            return await self._predict(message, call, accepted)

    async def list_models(self, request: models_pb.ListModelsRequest) -> models_pb.ListModelsResponse:
        """All models.

        Raises:
            Unavailable: not ready.
        """
        catalog = self._require_ready()
        return models_pb.ListModelsResponse(
            models=[catalog.describe(info) for info in catalog.models.infos()]
        )

    async def get_model(self, request: models_pb.GetModelRequest) -> models_pb.GetModelResponse:
        """One model.

        Raises:
            BadField: no name.
            UnknownModel: not loaded.
            Unavailable: not ready.
        """
        catalog = self._require_ready()
        if not request.name:
            raise BadField("name", "is required")
        return models_pb.GetModelResponse(model=catalog.describe(catalog.get(request.name).info))

    async def _predict(self, request: pb.PredictRequest, call: Call, accepted: float) -> pb.PredictResponse:
        catalog = call.catalog
        forecaster = catalog.get(request.model)
        options = read_options(request, forecaster.info, self._settings)
        before: TrackingResult | None = None
        agents: Agents | None = None
        with self._batcher.admit(options.predicted, accepted) as admission:
            if options.recalls:
                agents, before = await self._recall(request, options, forecaster, call)
            plan = await self._in_thread(
                make_plan, request, options, forecaster, catalog, self._settings, agents
            )
            results, outcomes = await self._forecast(plan, call.deadline, admission)
        seed = 0
        if options.samples:
            seed = secrets.randbits(32) if options.seed is None else options.seed
        encoding = self._in_thread(self._encode, plan, results, outcomes, seed)
        if not options.scene_id:
            response = await encoding
        else:
            remembered = before is not None and before.answered
            brought = sightings(plan, results, remembered)
            # The memory's answer mostly comes while this one is put together
            response, after = await asyncio.gather(encoding, self._remember(options, brought, call))
            report(response, before, after)
        self._count_agents(plan)
        return response

    def _encode(
        self, plan: Plan, results: Sequence[Result], outcomes: Sequence[Outcome], seed: int
    ) -> pb.PredictResponse:
        """The answer, and a look at the road. In a thread: it takes milliseconds."""
        raster = None if plan.scene is None else plan.scene.raster
        for name, count in count_off_road(raster, results).items():
            self._metrics.off_road.labels(name).inc(count)
        return encode(plan, results, outcomes, seed)

    async def _recall(
        self, request: pb.PredictRequest, options: Options, forecaster: Forecaster, call: Call
    ) -> tuple[Agents, TrackingResult]:
        """The agents, with what the memory knows of them."""
        agents = await self._in_thread(read_agents, request, self._settings)
        own = observed(agents, (forecaster, call.catalog.fallback))
        tracked = await self._tracker.exchange(
            options.scene_id,
            options.time,
            own,
            call.left() - _RESERVE,
            history_s=history_seconds(frames_of(forecaster, call.catalog)),
            latest=options.consistency,
        )
        return with_histories(agents, own, tracked.histories), tracked

    async def _remember(self, options: Options, brought: Sequence[TrackUpdate], call: Call) -> TrackingResult:
        latest = options.consistency and not options.recalls
        return await self._tracker.exchange(
            options.scene_id, options.time, brought, call.left() - _RESERVE, latest=latest
        )

    async def _forecast(
        self, plan: Plan, deadline: float, admission: Admission
    ) -> tuple[list[Result], list[Outcome]]:
        """Runs the plan; agents whose forecast is not finite get another one from the fallback."""
        outcomes = await self._batcher.run([group.job for group in plan.groups], deadline, admission)
        results, broken = await self._in_thread(_sift, plan.groups, outcomes)
        if not broken:
            return results, outcomes
        self._reassign(plan, broken)
        again = await self._in_thread(
            plan.add_groups, [draft for draft in broken if draft.status != pb.FORECAST_STATUS_INVALID]
        )
        more = await self._batcher.run([group.job for group in again], deadline, admission)
        rescued, lost = await self._in_thread(_sift, again, more)
        self._reassign(plan, lost)
        check_strict(plan)
        return [*results, *rescued], [*outcomes, *more]

    def _reassign(self, plan: Plan, broken: Sequence[Draft]) -> None:
        """Hands agents on to the fallback, or gives them up if it was the fallback that failed."""
        for draft in broken:
            failed = draft.forecaster
            if failed is None:
                continue
            self._metrics.nonfinite.labels(failed.info.name).inc()
            why = f"the forecast of {failed.info.name} was not finite"
            here = f"agents[{draft.index}]"
            if failed is plan.fallback:
                draft.invalidate(Fault(here, why))
            else:
                fall_back(draft, plan.fallback, here, why)
        if broken:
            _log.error("forecasts not finite", model=plan.forecaster.info.name, agents=len(broken))

    def _count_agents(self, plan: Plan) -> None:
        name = plan.forecaster.info.name
        for status, count in Counter(draft.status for draft in plan.drafts).items():
            text = pb.ForecastStatus.Name(status).removeprefix("FORECAST_STATUS_").lower()
            self._metrics.agents.labels(name, text).inc(count)

    def _require_ready(self) -> Catalog:
        self._lifecycle.require_ready()
        if self._catalog is None:
            raise Unavailable("the server is starting")
        return self._catalog

    async def _in_thread(self, function: Callable[..., _T], *arguments: object) -> _T:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


def _sift(groups: Sequence[Group], outcomes: Sequence[Outcome]) -> tuple[list[Result], list[Draft]]:
    """What can be sent, and the agents whose forecast cannot."""
    results: list[Result] = []
    broken: list[Draft] = []
    for group, outcome in zip(groups, outcomes, strict=True):
        good = finite(outcome.mixture)
        if good.all():
            results.append(Result(group.drafts, outcome.mixture))
            continue
        broken.extend(draft for draft, fine in zip(group.drafts, good.tolist(), strict=True) if not fine)
        kept = np.flatnonzero(good)
        if len(kept):
            drafts = [group.drafts[row] for row in kept.tolist()]
            results.append(Result(drafts, outcome.mixture[torch.from_numpy(kept)]))
    return results, broken
