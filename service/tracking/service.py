"""Consistency calls, from request message to response message; transports only carry them."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import aclosing

from cab.forecast.v1 import consistency_service_pb2 as pb
from service.access.watchers import Watchers
from service.errors import BadField, TrackingUnavailable, UnknownTrack, check_id
from service.lifecycle import Lifecycle
from service.tracking.aggregates import Aggregates
from service.tracking.messages import instant_messages, model_messages
from service.tracking.metrics import InstantMetrics, instant_metrics
from service.tracking.model_references import ModelReferences
from service.tracking.store.base import WINDOW, SceneSnapshot, StoreError, TrackStore
from service.tracking.store.guard import Guard
from service.tracking.tracker import STORE_TIMEOUT, Tracker

DEFAULT_WINDOW = 2.0
"""Seconds of an agent's observations, counted back from its newest one."""
SCENE_WINDOW = 4.0
"""Seconds for the aggregates of a scene; longer, because off-lag forecasts settle after 2 s."""


class ConsistencyService:
    """Consistency of the forecasts, as the track memory knows it.

    Args:
        store: the track memory.
        guard: guard of the calls to it.
        tracker: tracker of the Predict calls.
        references: references to models.
        lifecycle: lifecycle of the server.
        watchers: bound the ``watch_scene`` calls, and end them.
    """

    def __init__(
        self,
        store: TrackStore,
        guard: Guard,
        tracker: Tracker,
        references: ModelReferences,
        lifecycle: Lifecycle,
        watchers: Watchers,
    ) -> None:
        self._store = store
        self._guard = guard
        self._tracker = tracker
        self._references = references
        self._lifecycle = lifecycle
        self._watchers = watchers

    async def get_agent(self, request: pb.GetAgentConsistencyRequest) -> pb.GetAgentConsistencyResponse:
        """Return the consistency of one agent over its last seconds.

        Raises:
            BadField: an id is missing or too long, or the window is out of range.
            UnknownTrack: the track memory does not know the agent.
            TrackingUnavailable: the track memory is unavailable.
            Unavailable: the server is not ready.
        """
        self._lifecycle.require_ready()
        check_id("scene_id", request.scene_id)
        check_id("agent_id", request.agent_id)
        if not 0 <= request.window <= WINDOW:
            raise BadField("window", f"must be within 0 … {WINDOW:g} s")
        snapshot = await self._read(request.scene_id, request.window or DEFAULT_WINDOW, request.agent_id)
        metrics = await asyncio.to_thread(instant_metrics, snapshot.instants.packed)
        return pb.GetAgentConsistencyResponse(instants=self._messages(metrics, snapshot, range(len(metrics))))

    async def get_scene(self, request: pb.GetSceneConsistencyRequest) -> pb.GetSceneConsistencyResponse:
        """Return the current consistency of a scene.

        Raises:
            BadField, UnknownTrack, TrackingUnavailable, Unavailable: as ``get_agent``.
        """
        self._lifecycle.require_ready()
        check_id("scene_id", request.scene_id)
        snapshot = await self._read(request.scene_id, SCENE_WINDOW)
        instants = snapshot.instants
        metrics = await asyncio.to_thread(instant_metrics, instants.packed)
        newest: dict[tuple[str, str], int] = {}
        for row, key in enumerate(zip(instants.agent_ids, instants.models, strict=True)):
            newest[key] = row  # rows ascend by time, so the last one remains
        aggregates = Aggregates()
        aggregates.add(metrics, instants.models, newly_only=False)
        return pb.GetSceneConsistencyResponse(
            latest=self._messages(metrics, snapshot, [newest[key] for key in sorted(newest)]),
            models=model_messages(aggregates, self._references),
        )

    async def list_models(self, request: pb.ListModelConsistencyRequest) -> pb.ListModelConsistencyResponse:
        """Return the aggregates over the lifetime of the process, by model.

        Raises:
            Unavailable: the server is not ready.
        """
        self._lifecycle.require_ready()
        self._tracker.aggregate_pending()
        return pb.ListModelConsistencyResponse(
            models=model_messages(self._tracker.aggregates, self._references)
        )

    async def reset_scene(self, request: pb.ResetSceneRequest) -> pb.ResetSceneResponse:
        """Delete a scene from the track memory.

        Raises:
            BadField, TrackingUnavailable, Unavailable: as ``get_agent``.
        """
        self._lifecycle.require_ready()
        check_id("scene_id", request.scene_id)
        try:
            agents = await self._guard.run(
                "reset", lambda: self._store.reset(request.scene_id), STORE_TIMEOUT
            )
        except StoreError as error:
            raise TrackingUnavailable(str(error)) from error
        return pb.ResetSceneResponse(agents=agents)

    async def watch_scene(self, request: pb.WatchSceneRequest) -> AsyncIterator[pb.WatchSceneResponse]:
        """Yield events of a scene until the caller closes the iterator or the server drains.

        Raises:
            BadField, TrackingUnavailable, Unavailable: as ``get_agent``.
            Overloaded: there are too many watchers.
        """
        self._lifecycle.require_ready()
        check_id("scene_id", request.scene_id)
        async with self._watchers.watching("WatchScene"):
            source = self._watchers.until_ended(self._store.watch(request.scene_id))
            try:
                async with aclosing(source):
                    async for events, missed in source:
                        instants = [pb.InstantConsistency.FromString(event) for event in events]
                        yield pb.WatchSceneResponse(instants=instants, missed=missed)
            except StoreError as error:
                raise TrackingUnavailable(str(error)) from error

    def end_watching(self) -> None:
        """End all streams of events."""
        self._watchers.end()

    async def _read(self, scene_id: str, window: float, agent_id: str | None = None) -> SceneSnapshot:
        try:
            snapshot = await self._guard.run(
                "read", lambda: self._store.read(scene_id, window, agent_id), STORE_TIMEOUT
            )
        except StoreError as error:
            raise TrackingUnavailable(str(error)) from error
        if not snapshot.agent_ids:
            unknown = "this scene" if agent_id is None else "this agent"
            raise UnknownTrack(f"nothing is remembered of {unknown}")
        return snapshot

    def _messages(
        self, metrics: InstantMetrics, snapshot: SceneSnapshot, rows: Sequence[int]
    ) -> list[pb.InstantConsistency]:
        instants = snapshot.instants
        agent_ids = [instants.agent_ids[row] for row in rows]
        models = [instants.models[row] for row in rows]
        return instant_messages(metrics.rows(rows), agent_ids, models, self._references)
