"""Shadow model: a second model that forecasts a share of the calls, for its metrics alone.

A call is offered once its response has been sent. It is forecast while nothing waits for the model, a few
agents at a time, so that calls which arrive meanwhile wait for about 10 ms at most. What has no place in the
queue, or finds the model busy for a second, is dropped. Nothing of it is in any response: its tracks have
scenes of their own, whose ids are longer than those of any request.
"""

import asyncio
import hashlib
import random
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace

import structlog

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.bounds import MAX_ID_LENGTH
from model.forecaster import Context, Forecaster
from model.scenes.scene import Raster
from service.errors import UnknownModel
from service.predict.batcher import Batcher, combine
from service.predict.catalog import Catalog
from service.predict.encode import count_off_road
from service.predict.plan import Plan, make_plan, set_outcomes
from service.predict.publisher import Publisher
from service.predict.request import Agents, Options
from service.predict.torch_threads import set_helper_threads
from service.predict.track_updates import forecast_updates
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.tracking.tracker import STORE_TIMEOUT, Tracker

_log = structlog.get_logger(__name__)

_MAX_CALLS = 32
_MAX_BYTES = 64 * 2**20
_MAX_AGE = 1.0
"""Seconds that a call waits before it is dropped; the track memory accepts calls that are up to 2 s late."""


@dataclass(frozen=True)
class _Work:
    """A call to forecast again."""

    request: pb.PredictRequest
    options: Options
    agents: Agents
    raster: Raster | None
    """Map of the call, decoded; a request that names its map by the digest alone does not hold it."""
    forecaster: Forecaster
    catalog: Catalog
    size: int
    """Bytes of the request."""
    until: float
    """Time on the event loop's clock after which it is dropped."""


class _LateError(Exception):
    """Error of work that the model had no time for."""


class Shadow:
    """Queue and worker of the shadow model. Used on one event loop."""

    def __init__(
        self,
        name: str,
        share: float,
        settings: Settings,
        metrics: Metrics,
        batcher: Batcher,
        tracker: Tracker,
        publisher: Publisher,
    ) -> None:
        """
        Args:
            name: name of the model, ``name@version``.
            share: share of the scenes, and of the calls without one.
            settings: the limits.
            metrics: receives its series, with ``name@version`` as the model.
            batcher: runs its forwards.
            tracker: stores its forecasts, and aggregates what comes of them.
            publisher: shows its forecasts to those who watch the scene.
        """
        self._name = name
        self._share = share
        self._settings = settings
        self._metrics = metrics
        self._batcher = batcher
        self._tracker = tracker
        self._publisher = publisher
        self._forecaster: Forecaster | None = None
        self._queue: deque[_Work] = deque()
        self._bytes = 0
        self._wake = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="shadow", initializer=set_helper_threads)
        self._worker: asyncio.Task[None] | None = None

    def set_catalog(self, catalog: Catalog) -> None:
        """Find the model among those that calls begin with; without it no call is forecast again."""
        try:
            self._forecaster = catalog.get(self._name)
        except UnknownModel as error:
            self._forecaster = None
            _log.warning("no shadow model", reason=str(error))
            return
        for result in ("done", "dropped", "failed"):
            self._metrics.shadow_calls.labels(self._forecaster.info.full_name, result)
        _log.info("shadow model", name=self._forecaster.info.full_name, share=self._share)
        if self._worker is None:
            self._worker = asyncio.create_task(self._work(), name="shadow")

    def offer(self, request: pb.PredictRequest, plan: Plan, catalog: Catalog) -> None:
        """Queue a call that was answered, if it is of the share and there is room.

        Args:
            request: its request.
            plan: its plan.
            catalog: its models.
        """
        forecaster = self._forecaster
        options = plan.options
        if forecaster is None or forecaster is plan.forecaster or plan.scene is None:
            return
        if options.context is Context.BLIND or not self._is_chosen(options.scene_id):
            return
        size = request.ByteSize()
        if len(self._queue) >= _MAX_CALLS or self._bytes + size > _MAX_BYTES:
            self._count(forecaster, "dropped")
            return
        own = replace(
            options,
            strict=False,
            samples=0,
            steps=min(options.steps, forecaster.info.steps),
            consistency=False,
        )
        until = asyncio.get_running_loop().time() + _MAX_AGE
        self._queue.append(
            _Work(request, own, plan.agents, plan.scene.raster, forecaster, catalog, size, until)
        )
        self._bytes += size
        self._wake.set()

    async def close(self) -> None:
        """Drop what is queued, and release the thread."""
        if self._worker is not None:
            self._worker.cancel()
            with suppress(asyncio.CancelledError):
                await self._worker
        self._queue.clear()
        await asyncio.to_thread(self._thread.shutdown, cancel_futures=True)

    def _is_chosen(self, scene_id: str) -> bool:
        """Return whether a call is of the share: all calls of a scene are, on every server, or none.

        Consistency needs a scene's forecasts of 6 s without a gap.
        """
        if not scene_id:
            return random.random() < self._share  # noqa: S311 - no secret
        digest = hashlib.blake2b(scene_id.encode(), digest_size=8).digest()
        return int.from_bytes(digest, "little") < self._share * 2**64

    async def _work(self) -> None:
        while True:
            while not self._queue:
                self._wake.clear()
                await self._wake.wait()
            work = self._queue.popleft()
            self._bytes -= work.size
            result = "failed"
            try:
                await self._forecast(work)
                result = "done"
            except _LateError:
                result = "dropped"
            except Exception:
                _log.exception("shadow failed", model=work.forecaster.info.full_name)
            self._count(work.forecaster, result)

    async def _forecast(self, work: _Work) -> None:
        """Forecast a call again, store and count what comes of it.

        Raises:
            _LateError: the model had no time for it.
        """
        loop = asyncio.get_running_loop()
        await self._until_free(work)
        plan = await loop.run_in_executor(
            self._thread,
            make_plan,
            work.request,
            work.options,
            work.forecaster,
            work.catalog,
            self._settings,
            work.agents,
            work.raster,
        )
        groups = [group for group in plan.groups if group.job.forecaster is work.forecaster]
        outcomes = []
        name = work.forecaster.info.full_name
        for group in groups:
            parts = []
            for part in self._batcher.spare_parts(group.job):
                await self._until_free(work)
                parts.append(await self._batcher.run_spare(part))
            outcome = replace(combine(parts), queue=0.0)  # nothing waited for it
            self._metrics.inference.labels(name).observe(outcome.inference)
            outcomes.append(outcome)
        broken = await loop.run_in_executor(self._thread, set_outcomes, groups, outcomes)
        self._metrics.nonfinite.labels(name).inc(len(broken))
        raster = None if plan.scene is None else plan.scene.raster
        left = await loop.run_in_executor(self._thread, count_off_road, raster, groups)
        self._metrics.off_road.labels(name).inc(left.total())
        self._metrics.count_agents(name, (draft.status for draft in plan.drafts))
        options = work.options
        if options.scene_id:
            updates = await loop.run_in_executor(self._thread, forecast_updates, plan, False)
            scene_id = _own_scene(options.scene_id, name)
            stored = await self._tracker.exchange(scene_id, options.time, updates, STORE_TIMEOUT)
            self._publisher.shadowed(work.request, plan, stored.instants)

    async def _until_free(self, work: _Work) -> None:
        """Wait until nothing waits for the model.

        Raises:
            _LateError: that took too long.
        """
        if not await self._batcher.until_free(work.until):
            raise _LateError

    def _count(self, forecaster: Forecaster, result: str) -> None:
        self._metrics.shadow_calls.labels(forecaster.info.full_name, result).inc()


def _own_scene(scene_id: str, model: str) -> str:
    """Return the id of the shadow's scene, which is longer than any id of a request."""
    return f"{scene_id} as forecast by {model}".ljust(MAX_ID_LENGTH + 1)
