"""Publication of answered calls for those who watch their scenes; it delays no answer.

A call is offered once its response has been sent. Nothing is made of it unless its scene is watched; then one
thread makes the frame. Frames that are asked for faster than that are dropped.
"""

import asyncio
from concurrent.futures import ThreadPoolExecutor

import structlog

from cab.forecast.v1 import prediction_service_pb2 as predict_pb
from cab.forecast.v1 import scene_service_pb2 as pb
from cab.forecast.v1.digest import raster_digest
from service.predict.frames import build_frame
from service.predict.plan import Plan
from service.predict.torch_threads import set_helper_threads
from service.scenes.fanout import FrameFanout, PublishedFrame, PublishedMap
from service.scenes.live import LiveScenes
from service.scenes.map_image import scene_map
from service.scenes.shared_message import SharedMessage
from service.telemetry.metrics import Metrics
from service.tracking.model_references import ModelReferences
from service.tracking.store.base import Instants
from service.tracking.tracker import latest_consistency

_log = structlog.get_logger(__name__)

_MAX_CALLS = 16
"""Max number of calls whose frames are being made or wait for it."""


class Publisher:
    """Maker of frames. Used on one event loop; frames are made and encoded in a thread."""

    def __init__(
        self, live: LiveScenes, fanout: FrameFanout, references: ModelReferences, metrics: Metrics
    ) -> None:
        """
        Args:
            live: is told of each call.
            fanout: knows which scenes are watched, and delivers their frames.
            references: references to models.
            metrics: count the frames.
        """
        self._live = live
        self._fanout = fanout
        self._references = references
        self._metrics = metrics
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="frames", initializer=set_helper_threads)
        self._tasks: set[asyncio.Task[None]] = set()

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
        """Drop what is not made yet, and release the thread."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.to_thread(self._thread.shutdown, cancel_futures=True)

    def _offer(
        self,
        request: predict_pb.PredictRequest,
        plan: Plan,
        response: predict_pb.PredictResponse | None,
        instants: Instants,
    ) -> None:
        if not self._fanout.is_watched(plan.options.scene_id):
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
            event, shown = await asyncio.get_running_loop().run_in_executor(
                self._thread, self._make, request, plan, response, instants
            )
        except Exception:
            _log.exception("no frame", scene_id=scene_id)
            return
        message = SharedMessage(event, self._thread)
        shadow = response is None
        self._metrics.frames.inc()
        self._fanout.publish(scene_id, PublishedFrame(shadow, message, shown))

    def _make(
        self,
        request: predict_pb.PredictRequest,
        plan: Plan,
        response: predict_pb.PredictResponse | None,
        instants: Instants,
    ) -> tuple[pb.WatchForecastsResponse, PublishedMap | None]:
        """Return the event of a call, and the map that it saw. Runs in the thread."""
        models = {
            draft.agent_id: draft.forecaster.info.full_name
            for draft in plan.drafts
            if draft.forecaster is not None
        }
        consistency = latest_consistency(models, instants, self._references)
        forecasts = () if response is None else response.forecasts
        frame = build_frame(request, plan, forecasts, consistency, shadow=response is None)
        shown = self._map(request, plan)
        if shown is not None:
            frame.map_digest = shown.digest
        return pb.WatchForecastsResponse(frame=frame), shown

    def _map(self, request: predict_pb.PredictRequest, plan: Plan) -> PublishedMap | None:
        """Return the map that a call saw, which is made once for as long as it is shown."""
        raster = None if plan.scene is None else plan.scene.raster
        if raster is None:
            return None
        digest = request.scene_raster.digest or raster_digest(request.scene_raster)
        known = self._fanout.map_of(plan.options.scene_id, digest)
        if known is not None:
            return known
        event = pb.WatchForecastsResponse(map=scene_map(raster, digest))
        return PublishedMap(digest, SharedMessage(event, self._thread))
