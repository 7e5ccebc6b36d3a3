"""Service without its transports: construction, start and end of everything that a call needs."""

import asyncio
import dataclasses
from concurrent.futures import ThreadPoolExecutor

import structlog

from cab.forecast.v1 import admin_service_pb2 as admin_pb
from cab.forecast.v1 import model_service_pb2 as pb
from service.access.watchers import Watchers
from service.cores import whole_cores
from service.errors import BadField, Unavailable
from service.lifecycle import Lifecycle, Phase
from service.predict.admission import Admission
from service.predict.batcher import Batcher
from service.predict.catalog import Catalog, reference
from service.predict.explanation import Explainer
from service.predict.pipeline import Pipeline
from service.predict.publisher import Publisher
from service.predict.rasters.library import RasterLibrary
from service.predict.rasters.shared import SharedRasters
from service.predict.reload import Load, Reloader
from service.predict.shadow import Shadow
from service.predict.torch_threads import forward_threads, set_helper_threads
from service.recording.factory import make_recorder
from service.scenes.fanout import FrameFanout
from service.scenes.live import LiveScenes
from service.scenes.service import SceneService, make_shared_scenes
from service.settings import Settings, split_shadow
from service.telemetry.build import build_of
from service.telemetry.metrics import Metrics
from service.tracking.collector import ConsistencyCollector, StoreMetrics
from service.tracking.model_references import ModelReferences
from service.tracking.service import ConsistencyService
from service.tracking.store.factory import make_store
from service.tracking.store.guard import Guard
from service.tracking.tracker import Tracker

_log = structlog.get_logger(__name__)

_MAX_WORKERS = 8
_RECORDER_SECONDS = 5.0
"""Seconds that a recording gets to end."""


class DataPlane:
    """The interface of the transports to the server's work. Used on one event loop."""

    def __init__(self, settings: Settings, metrics: Metrics) -> None:
        self._settings = settings
        self._metrics = metrics
        self._build = build_of(settings.revision)
        metrics.set_build(self._build)
        self._lifecycle = Lifecycle()
        self._references = ModelReferences()
        self._admission = Admission(settings.max_batch_agents, settings.max_queue_agents, metrics)
        self._batcher = Batcher(
            settings.max_batch_agents,
            self._admission,
            metrics,
            forward_threads(settings.threads, settings.workers),
        )
        self._threads = ThreadPoolExecutor(
            min(_MAX_WORKERS, whole_cores() + 1),
            thread_name_prefix="calls",
            initializer=set_helper_threads,
        )
        self._store = make_store(settings)
        self._shadow_guard: Guard | None = None
        store_metrics = StoreMetrics(metrics.registry)
        self._guard = Guard(store_metrics.observe, store_metrics.failed, calls="forecasts")
        # A guard of their own, so that slow consistency calls do not open the circuit of the forecasts
        self._asking = Guard(store_metrics.observe, store_metrics.failed, calls="consistency")
        tracker = Tracker(
            self._store, self._guard, self._asking, settings.store_budget_ms / 1000, self._references
        )
        shadow_tracker = self._make_shadow_tracker(store_metrics)
        shadow_aggregates = None if shadow_tracker is None else shadow_tracker.aggregates
        metrics.registry.register(ConsistencyCollector(tracker.aggregates, shadow_aggregates))
        watchers = Watchers(settings.max_watchers, metrics)
        self.consistency = ConsistencyService(
            self._store, self._asking, tracker, self._references, self._lifecycle, watchers
        )
        """Calls of the consistency service."""
        live = LiveScenes(settings.track_expiry)
        self._frame_thread = ThreadPoolExecutor(
            1, thread_name_prefix="frames", initializer=set_helper_threads
        )
        fanout = FrameFanout(settings.max_frame_bytes, metrics, self._frame_thread)
        self._shared_scenes = make_shared_scenes(settings, live, fanout, store_metrics)
        self.scenes = SceneService(live, fanout, self._shared_scenes, watchers, self._lifecycle)
        """Calls of the scene service."""
        self._rasters = RasterLibrary(
            settings, metrics, self._threads, SharedRasters.from_settings(settings, store_metrics)
        )
        self._publisher = Publisher(
            live,
            fanout,
            self._shared_scenes,
            self._references,
            self._rasters,
            metrics,
            self._frame_thread,
        )
        self._pipeline = Pipeline(
            settings,
            metrics,
            self._lifecycle,
            self._admission,
            self._batcher,
            tracker,
            self._rasters,
            self._publisher,
            self._threads,
        )
        if settings.shadow is not None and shadow_tracker is not None:
            name, share = split_shadow(settings.shadow)
            self._pipeline.shadow = Shadow(
                name, share, settings, metrics, self._batcher, shadow_tracker, self._publisher
            )
        self._explainer = Explainer(
            settings, metrics, self._lifecycle, self._batcher, self._rasters, self._threads
        )
        self._reloader: Reloader | None = None
        self._reloads: set[asyncio.Task[admin_pb.ReloadModelsResponse]] = set()
        self._following: asyncio.Task[None] | None = None
        self.accept = self._pipeline.accept
        """See ``Pipeline.accept``."""
        self.predict = self._pipeline.predict
        """See ``Pipeline.predict``."""
        self.accept_explanation = self._explainer.accept
        """See ``Explainer.accept``."""
        self.explain = self._explainer.explain
        """See ``Explainer.explain``."""

    @property
    def phase(self) -> Phase:
        """Phase of the server."""
        return self._lifecycle.phase

    @property
    def failed(self) -> asyncio.Event:
        """Event that is set when the server can answer no call any more and must end."""
        return self._lifecycle.failed

    def require_ready(self) -> None:
        """Refuse a readiness probe unless calls are accepted and forecast.

        Raises:
            Unavailable: the server is starting or draining, or a forward has not returned for longer than any
                call may take.
        """
        self._lifecycle.require_ready()
        seconds = self._batcher.forward_seconds
        if seconds > self._settings.max_timeout:
            raise Unavailable(f"a forward of the model has not returned for {seconds:.0f} s")

    async def open(self, load: Load) -> None:
        """Load and warm up the models, then accept calls.

        Args:
            load: reads the models; called in a thread.

        Raises:
            SettingsError: a required model is missing, or calls cannot be recorded.
            Exception: any exception of ``load``.
        """
        self._pipeline.recorder = make_recorder(self._settings, self._metrics)
        self._reloader = Reloader(load, self._settings, self._batcher, self._metrics, self._take_over)
        self._batcher.start(self._lifecycle.fail)
        await asyncio.gather(self._reloader.start(), self._guard.check(self._store.ping))
        if self._shared_scenes is not None:
            self._shared_scenes.start()
        self._lifecycle.set_ready()
        catalog = self._pipeline.catalog
        self._batcher.start_workers(
            [catalog.get(info.full_name) for info in catalog.models.infos()], catalog.default
        )
        if self._settings.reload_seconds is not None:
            self._following = asyncio.create_task(
                self._reloader.follow(self._settings.reload_seconds), name="models"
            )

    async def reload_models(self, request: admin_pb.ReloadModelsRequest) -> admin_pb.ReloadModelsResponse:
        """Read the models again; a caller that goes away does not end it.

        Raises:
            ReloadRefused: the new models as a whole cannot be served; nothing has changed.
            Unavailable: the server is not ready.
        """
        self._lifecycle.require_ready()
        return await self.reload()

    async def reload(self) -> admin_pb.ReloadModelsResponse:
        """Read the models again, as ``reload_models`` does for every caller.

        Raises:
            ReloadRefused: the new models as a whole cannot be served; nothing has changed.
            Unavailable: the server is not ready.
        """
        self._lifecycle.require_ready()
        if self._reloader is None:
            raise Unavailable("the models are not loaded yet")
        reloading = asyncio.create_task(self._reloader.reload(), name="reload")
        self._reloads.add(reloading)
        reloading.add_done_callback(self._reloads.discard)
        return await asyncio.shield(reloading)

    def _make_shadow_tracker(self, store_metrics: StoreMetrics) -> Tracker | None:
        """Return the tracker of the shadow model, with a guard of its own; None if there is no such model."""
        if self._settings.shadow is None:
            return None
        self._shadow_guard = Guard(store_metrics.observe, store_metrics.failed, calls="shadow")
        return Tracker(
            self._store,
            self._shadow_guard,
            self._asking,
            self._settings.store_budget_ms / 1000,
            self._references,
        )

    def _take_over(self, catalog: Catalog) -> None:
        self._references.set_loaded(reference(info) for info in catalog.models.infos())
        self._pipeline.catalog = self._explainer.catalog = catalog
        if self._pipeline.shadow is not None:
            self._pipeline.shadow.set_catalog(catalog)

    def refuse(self) -> None:
        """Accept no more calls; those in progress go on, except streams of consistency events."""
        self._lifecycle.refuse()
        self.consistency.end_watching()

    async def drain(self, seconds: float) -> bool:
        """Refuse new calls and wait until the responses of all accepted calls have been sent.

        Args:
            seconds: timeout.

        Returns:
            False if calls are still in progress after the timeout.
        """
        self.refuse()
        idle = await self._lifecycle.wait_idle(seconds)
        if not idle:
            _log.warning("calls left unanswered", calls=self._lifecycle.calls)
        return idle

    async def close(self) -> None:
        """Refuse new calls and release threads and connections."""
        self.refuse()
        tasks = [*self._reloads, *([] if self._following is None else [self._following])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._reloader is not None:
            self._reloader.close()
        if self._pipeline.shadow is not None:
            await self._pipeline.shadow.close()
        await self._publisher.close()
        if self._shared_scenes is not None:
            await self._shared_scenes.close()
        await self._batcher.stop()
        if self._pipeline.recorder is not None:
            await asyncio.to_thread(self._pipeline.recorder.close, _RECORDER_SECONDS)
        await self._guard.close()
        if self._shadow_guard is not None:
            await self._shadow_guard.close()
        await self._asking.close()
        await self._store.close()
        await self._rasters.close()
        await asyncio.to_thread(self._frame_thread.shutdown, cancel_futures=True)
        await asyncio.to_thread(self._threads.shutdown, cancel_futures=True)

    async def list_models(
        self, request: pb.ListModelsRequest, caller: str | None = None
    ) -> pb.ListModelsResponse:
        """Return all models.

        Args:
            request: the request.
            caller: name of the caller's key, who may have a default model; None: there is none.

        Raises:
            Unavailable: the server is not ready.
        """
        self._lifecycle.require_ready()
        catalog = self._pipeline.catalog
        models = [catalog.describe(info, caller) for info in catalog.models.infos()]
        return pb.ListModelsResponse(models=models)

    async def get_model(self, request: pb.GetModelRequest, caller: str | None = None) -> pb.GetModelResponse:
        """Return one model.

        Args:
            request: the request.
            caller: name of the caller's key, as in ``list_models``.

        Raises:
            BadField: the name is missing.
            UnknownModel: the model is not loaded.
            Unavailable: the server is not ready.
        """
        self._lifecycle.require_ready()
        if not request.name:
            raise BadField("name", "is required")
        catalog = self._pipeline.catalog
        return pb.GetModelResponse(model=catalog.describe(catalog.get(request.name).info, caller))

    async def get_version(self, request: pb.GetVersionRequest) -> pb.GetVersionResponse:
        """Return the version of the server, in every phase."""
        contract = pb.DESCRIPTOR.package
        return pb.GetVersionResponse(contract=contract, **dataclasses.asdict(self._build))
