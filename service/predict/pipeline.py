"""One Predict call from top to bottom: decode, validate, recall, plan, batch, encode, remember."""

import asyncio
import functools
import secrets
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol, TypeVar

import structlog

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.forecaster import Forecaster
from model.scenes.resample import history_seconds
from service.access.caller import Grant
from service.lifecycle import Lifecycle
from service.predict.admission import Admission, Call
from service.predict.batcher import Batcher, Outcome
from service.predict.catalog import Catalog
from service.predict.encode import count_off_road, encode
from service.predict.input_warnings import HISTORY_S, add_warnings, code_name, code_names, memory_warnings
from service.predict.plan import Group, Plan, frames_of, make_plan, set_outcomes
from service.predict.publisher import Publisher
from service.predict.rasters.library import RasterLibrary
from service.predict.request import Agents, Options, read_agents, read_options
from service.predict.request_reader import EncodedRequest, RequestReader
from service.predict.shadow import Shadow
from service.predict.track_updates import (
    forecast_updates,
    observation_updates,
    report,
    unambiguous,
    with_histories,
)
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.telemetry.tracing import past_span, span
from service.tracking.tracker import Tracker, TrackingResult

if TYPE_CHECKING:
    from service.recording.recorder import Recorder

_log = structlog.get_logger(__name__)

_T = TypeVar("_T")
_RESERVE = 0.005
"""Seconds before the deadline from which on a call does not wait for the track memory."""


_LIGHT_AGENTS = 32
_LIGHT_BYTES = 2**14
"""Bytes of a light request without its map: some 250 states."""
_LIGHT_MAP_BYTES = 2**17
"""Bytes of its map, which must not be a PNG."""


class _Work(Protocol):
    """Way to run a function for a call, and to wait for its result."""

    def __call__(self, call: Call, function: Callable[..., _T], *arguments: object) -> Awaitable[_T]: ...


class Pipeline:
    """Stages of a Predict call. Used on one event loop; what may take milliseconds runs in threads."""

    catalog: Catalog
    """Models that calls begin with; set before the lifecycle becomes ready, and by reloads."""
    recorder: "Recorder | None" = None
    """Recorder of answered calls, if any; set before the lifecycle becomes ready."""

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        lifecycle: Lifecycle,
        admission: Admission,
        batcher: Batcher,
        tracker: Tracker,
        rasters: RasterLibrary,
        publisher: Publisher,
        threads: Executor,
    ) -> None:
        self._settings = settings
        self._metrics = metrics
        self._lifecycle = lifecycle
        self._admission = admission
        self._batcher = batcher
        self._tracker = tracker
        self._rasters = rasters
        self._publisher = publisher
        self._threads = threads
        self._reader = RequestReader(threads)
        self.shadow: Shadow | None = None
        """Second model that forecasts a share of the calls; None: there is none."""
        metrics.begin_input_warnings(code_names())

    @contextmanager
    def accept(self, timeout: float | None = None, grant: Grant | None = None) -> Iterator[Call]:
        """Accept a call on its arrival, before its body is read; a drain waits for the end of the block.

        Args:
            timeout: the client's timeout, s; the server's own limit applies as well.
            grant: counts the agents of the request against the limits of the caller's key; None: there are
                no limits.

        Raises:
            Unavailable: the server is not ready.
            Overloaded: the queue is full, or the call would be late.
        """
        self._lifecycle.require_ready()
        limit = self._settings.max_timeout
        seconds = limit if timeout is None else min(timeout, limit)
        call = self._admission.admit(asyncio.get_running_loop().time() + seconds)
        if grant is not None:
            call.caller, call.grant = grant.caller.name, grant
        with self._lifecycle.in_progress():
            yield call
        for work in call.when_sent:
            work()

    async def predict(
        self, request: pb.PredictRequest | EncodedRequest[pb.PredictRequest], call: Call | None = None
    ) -> pb.PredictResponse:
        """Forecast the agents of a scene. Cancellation removes the call from the queue.

        Args:
            request: the request.
            call: the accepted call; None: it is accepted here.

        Raises:
            ServiceError: the call fails.
        """
        if call is None:
            with self.accept() as accepted:
                return await self.predict(request, accepted)
        call.started = time.perf_counter()
        async with call.in_time():
            # Decode
            with span("decode"):
                message = await self._reader.read(request) if isinstance(request, EncodedRequest) else request
            if call.grant is not None:
                call.grant.charge(len(message.agents))
            # Validate
            catalog = self.catalog  # of the whole call, even if other models take over meanwhile
            forecaster = catalog.get(message.model, call.caller)
            options = read_options(message, forecaster.info, self._settings)
            agents: Agents | None = None
            recalled: TrackingResult | None = None
            work = self._at_once if _is_light(message, options) else self._in_thread
            with self._admission.in_progress(call, options.predicted, options.priority):
                # A map by its digest, which may be unknown; any other is read with the plan
                raster = await self._rasters.find(message.scene_raster, call.remaining() - _RESERVE)
                with span("turn"):
                    await self._admission.turn(call)
                # Recall
                if options.recalls:
                    agents, recalled = await self._recall(message, options, forecaster, catalog, call)
                # Plan
                with span("plan"):
                    plan = await work(
                        call,
                        make_plan,
                        message,
                        options,
                        forecaster,
                        catalog,
                        self._settings,
                        agents,
                        raster,
                    )
                # Batch
                await self._forecast(plan, call, work)
                # Encode and remember; the track memory usually responds while the response is being encoded
                encoding = self._encoded(plan, call, work)
                if not options.scene_id:
                    response = await encoding
                else:
                    response, stored = await asyncio.gather(encoding, self._remember(plan, recalled, call))
                    instants = (recalled or stored).instants
                    publish = functools.partial(self._publisher.answered, message, plan, response, instants)
                    call.when_sent.append(publish)
                    report(response, recalled, stored)
                    known = {} if options.recalls else stored.histories
                    told = memory_warnings(plan.agents, recalled or stored, known)
                    add_warnings(response, [draft.index for draft in plan.drafts], told)
        self._metrics.count_agents(plan.forecaster.info.name, (draft.status for draft in plan.drafts))
        self._count_warnings(response)
        if self.shadow is not None:
            call.when_sent.append(functools.partial(self.shadow.offer, message, plan, catalog))
        if self.recorder is not None:
            shown = raster if plan.scene is None else plan.scene.raster
            self.recorder.record(message, response, shown, {} if recalled is None else recalled.histories)
        return response

    async def _recall(
        self,
        request: pb.PredictRequest,
        options: Options,
        forecaster: Forecaster,
        catalog: Catalog,
        call: Call,
    ) -> tuple[Agents, TrackingResult]:
        """Return the agents with their histories from the track memory, and its response."""
        agents = await self._in_thread(call, read_agents, request, self._settings)
        own = observation_updates(agents, (forecaster, catalog.fallback))
        with span("memory"):
            tracked = await self._tracker.exchange(
                options.scene_id,
                options.time,
                unambiguous(agents, own),
                call.remaining() - _RESERVE,
                history_s=history_seconds(frames_of(forecaster, catalog)),
                latest=options.consistency,
            )
        return with_histories(agents, own, tracked.histories), tracked

    async def _forecast(self, plan: Plan, call: Call, work: "_Work") -> None:
        """Run the plan's forwards, and forwards of the fallback for forecasts that are not finite."""
        groups = list(plan.groups)
        while True:
            outcomes = await self._run(groups, call)
            broken = await work(call, set_outcomes, groups, outcomes)
            if not broken:
                break
            _log.error("forecasts not finite", model=plan.forecaster.info.name, agents=len(broken))
            for draft in broken:
                if draft.forecaster is not None:
                    self._metrics.nonfinite.labels(draft.forecaster.info.name).inc()
            groups = await self._in_thread(call, plan.replace_broken, broken)
        plan.check_strict()

    async def _run(self, groups: Sequence[Group], call: Call) -> list[Outcome]:
        """Run the forwards of the groups."""
        queued = time.perf_counter()
        outcomes = await self._batcher.run([group.job for group in groups], call)
        for group, outcome in zip(groups, outcomes, strict=True):
            begun = call.started + outcome.queue
            past_span("queue", queued, begun)
            ended = begun + outcome.inference
            forward = past_span(
                "forward",
                begun,
                ended,
                model=group.job.forecaster.info.full_name,
                agents=group.job.agents,
                batch_agents=outcome.batch_agents,
            )
            cut = begun + outcome.patches
            past_span("patches", begun, cut, parent=forward)
            past_span("network", cut, ended, parent=forward)
        return outcomes

    async def _encoded(self, plan: Plan, call: Call, work: "_Work") -> pb.PredictResponse:
        """Return the response of a plan whose forwards are done."""
        with span("encode"):
            return await work(call, self._encode, plan, _seed(plan.options))

    def _encode(self, plan: Plan, seed: int) -> pb.PredictResponse:
        raster = None if plan.scene is None else plan.scene.raster
        for name, count in count_off_road(raster, plan.groups).items():
            self._metrics.off_road.labels(name).inc(count)
        return encode(plan, seed)

    async def _remember(self, plan: Plan, recalled: TrackingResult | None, call: Call) -> TrackingResult:
        """Store the call in the track memory, and return its response."""
        options = plan.options
        stored = forecast_updates(plan, recalled is not None and recalled.answered)
        latest = options.consistency and not options.recalls
        patience = call.remaining() - _RESERVE
        history_s = None if options.recalls else HISTORY_S
        with span("memory"):
            return await self._tracker.exchange(
                options.scene_id, options.time, stored, patience, history_s=history_s, latest=latest
            )

    def _count_warnings(self, response: pb.PredictResponse) -> None:
        for forecast in response.forecasts:
            for warning in forecast.warnings:
                self._metrics.input_warnings.labels(code_name(warning.code)).inc()

    async def _at_once(self, call: Call, function: Callable[..., _T], *arguments: object) -> _T:
        """Run a function on the event loop, and count its time as the call's."""
        return _timed(call, function, *arguments)

    async def _in_thread(self, call: Call, function: Callable[..., _T], *arguments: object) -> _T:
        """Run a function in a helper thread, and count its time as the call's."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, _timed, call, function, *arguments)


def _timed(call: Call, function: Callable[..., _T], *arguments: object) -> _T:
    started = time.perf_counter()
    try:
        return function(*arguments)
    finally:
        call.helper_seconds += time.perf_counter() - started


def _is_light(request: pb.PredictRequest, options: Options) -> bool:
    """Return whether each part of the work for a call takes about as long as the handover to a thread."""
    if options.samples or options.merge or options.predicted > _LIGHT_AGENTS:
        return False
    image = request.scene_raster.image
    map_bytes = len(image.packed_bits)
    rest = request.ByteSize() - map_bytes
    return not image.png and map_bytes <= _LIGHT_MAP_BYTES and rest <= _LIGHT_BYTES


def _seed(options: Options) -> int:
    """Return the seed of a call's samples; 0 if none are drawn."""
    if not options.samples:
        return 0
    return secrets.randbits(32) if options.seed is None else options.seed
