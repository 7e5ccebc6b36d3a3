"""Publication of answered calls for those who watch their scenes; it delays no answer.

A call is offered once its response has been sent. Nothing is made of it unless its scene is watched; then one
thread makes the frame. Frames that are asked for faster than that are dropped.
"""

import asyncio
import functools
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import structlog

from cab.forecast.v1 import prediction_service_pb2 as predict_pb
from cab.forecast.v1 import scene_service_pb2 as pb
from cab.forecast.v1.digest import raster_digest
from service.predict.frames import build_frame, frame_bytes, frame_json, frame_message
from service.predict.plan import Plan
from service.predict.rasters.library import RasterLibrary
from service.scenes.fanout import FrameFanout, PublishedFrame, PublishedMap
from service.scenes.live import LiveScenes
from service.scenes.map_image import scene_map
from service.scenes.shared_message import SharedMessage
from service.telemetry.metrics import Metrics
from service.tracking.messages import latest_documents
from service.tracking.model_references import ModelReferences
from service.tracking.store.base import Instants

if TYPE_CHECKING:
    from service.scenes.shared import SharedScenes

_log = structlog.get_logger(__name__)

_MAX_CALLS = 16
"""Max number of calls whose frames are being made or wait for it."""
_MAX_MAPS = 16
"""Max number of maps that are kept for further frames, each of some 100 kB."""


class Publisher:
    """Maker of frames. Used on one event loop; frames are made and encoded in a thread."""

    def __init__(
        self,
        live: LiveScenes,
        fanout: FrameFanout,
        shared: "SharedScenes | None",
        references: ModelReferences,
        rasters: RasterLibrary,
        metrics: Metrics,
        thread: ThreadPoolExecutor,
    ) -> None:
        """
        Args:
            live: is told of each call.
            fanout: knows which scenes are watched, and delivers their frames.
            shared: does so for the watchers of other servers; None: there are none.
            references: references to models.
            rasters: keep the maps that frames name.
            metrics: count the frames.
            thread: the one thread that makes frames.
        """
        self._live = live
        self._fanout = fanout
        self._shared = shared
        self._references = references
        self._rasters = rasters
        self._metrics = metrics
        self._thread = thread
        self._tasks: set[asyncio.Task[None]] = set()
        self._maps: OrderedDict[bytes, PublishedMap] = OrderedDict()
        """Maps that were shown last, by digest; used in the thread."""

    def answered(
        self,
        request: predict_pb.PredictRequest,
        plan: Plan,
        response: predict_pb.PredictResponse,
        instants: Instants,
    ) -> None:
        """Take a call of a scene that was answered. Takes microseconds.

        Args:
            request: its request, which does not change any more.
            plan: its plan, likewise.
            response: its response, likewise.
            instants: what the track memory returned.
        """
        options = plan.options
        agents = sum(draft.forecaster is not None for draft in plan.drafts)
        self._live.called(options.scene_id, options.time, agents, response.model)
        self._offer(request, plan, response, instants)

    def shadowed(self, request: predict_pb.PredictRequest, plan: Plan, instants: Instants) -> None:
        """Take a call of a scene that the shadow model has forecast.

        Args:
            request: its request.
            plan: the shadow's plan.
            instants: what the track memory returned for the shadow.
        """
        self._offer(request, plan, None, instants)

    async def close(self) -> None:
        """Drop what is not made yet."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _offer(
        self,
        request: predict_pb.PredictRequest,
        plan: Plan,
        response: predict_pb.PredictResponse | None,
        instants: Instants,
    ) -> None:
        scene_id = plan.options.scene_id
        elsewhere = self._shared is not None and self._shared.is_watched(scene_id)
        if not elsewhere and not self._fanout.is_watched(scene_id):
            return
        if len(self._tasks) >= _MAX_CALLS:
            self._metrics.frames_dropped.labels("busy").inc()
            return
        task = asyncio.create_task(self._publish(request, plan, response, instants), name="frame")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _publish(
        self,
        request: predict_pb.PredictRequest,
        plan: Plan,
        response: predict_pb.PredictResponse | None,
        instants: Instants,
    ) -> None:
        scene_id = plan.options.scene_id
        try:
            # The thread takes one after the other, so that frames keep the order of the calls
            frame = await asyncio.get_running_loop().run_in_executor(
                self._thread, self._make, request, plan, response, instants
            )
        except Exception:
            _log.exception("no frame", scene_id=scene_id)
            return
        self._metrics.frames.inc()
        raster = None if plan.scene is None else plan.scene.raster
        if frame.map is not None and raster is not None and not request.scene_raster.digest:
            self._rasters.keep(frame.map.digest, request.scene_raster, raster)
        self._fanout.publish(scene_id, frame)
        if self._shared is None or not self._shared.is_watched(scene_id):
            return
        if not self._shared.publish(scene_id, frame):
            self._metrics.frames_dropped.labels("redis").inc()

    def _make(
        self,
        request: predict_pb.PredictRequest,
        plan: Plan,
        response: predict_pb.PredictResponse | None,
        instants: Instants,
    ) -> PublishedFrame:
        """Return the frame of a call. Runs in the thread."""
        models = {
            draft.agent_id: draft.forecaster.info.full_name
            for draft in plan.drafts
            if draft.forecaster is not None
        }
        shown = self._map(request, plan)
        document = build_frame(
            request,
            plan,
            () if response is None else response.forecasts,
            latest_documents(models, instants, self._references),
            shadow=response is None,
            map_digest=b"" if shown is None else shown.digest,
        )
        message = SharedMessage(
            functools.partial(frame_message, document),
            self._thread,
            frame_bytes(document),
            functools.partial(frame_json, document),
        )
        return PublishedFrame(response is None, message, shown)

    def _map(self, request: predict_pb.PredictRequest, plan: Plan) -> PublishedMap | None:
        """Return the map that a call saw, which is made once for as long as it is shown."""
        raster = None if plan.scene is None else plan.scene.raster
        if raster is None:
            return None
        digest = request.scene_raster.digest or raster_digest(request.scene_raster)
        known = self._maps.pop(digest, None)
        if known is None:
            event = pb.WatchForecastsResponse(map=scene_map(raster, digest))
            known = PublishedMap(digest, SharedMessage(event, self._thread))
        self._maps[digest] = known
        while len(self._maps) > _MAX_MAPS:
            self._maps.popitem(last=False)
        return known
