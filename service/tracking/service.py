"""The calls about consistency, from request message to answer message; the transports only carry them."""

import asyncio
from collections.abc import AsyncIterator, Sequence

from cab.forecast.v1 import consistency_service_pb2 as pb
from cab.forecast.v1.bounds import MAX_ID_LENGTH
from service.errors import BadField, Overloaded, TrackingUnavailable, UnknownTrack, id_too_long
from service.lifecycle import Lifecycle
from service.tracking.aggregates import Sums
from service.tracking.messages import instant_messages, model_messages
from service.tracking.metrics import Figures, figures
from service.tracking.model_references import ModelReferences
from service.tracking.store.base import WINDOW, Remembered, StoreError, TrackStore
from service.tracking.store.factory import MAX_WATCHERS
from service.tracking.store.guard import Guard
from service.tracking.tracker import PATIENCE, Tracker

DEFAULT_WINDOW = 2.0
"""s back from an agent's newest observation."""
SCENE_WINDOW = 4.0
"""The same for the sums of a scene: what was not on its lag is settled after 2 s."""
_WATCH_RETRY = 5.0
"""s until a place among the watchers may be free."""


class ConsistencyService:
    """What the track memory tells those who ask for it.

    Args:
        store: the memory.
        guard: of the calls to it.
        tracker: the tracker of the Predict calls.
        references: references to models.
        lifecycle: the lifecycle of the server.
    """

    def __init__(
        self,
        store: TrackStore,
        guard: Guard,
        tracker: Tracker,
        references: ModelReferences,
        lifecycle: Lifecycle,
    ) -> None:
        self._store = store
        self._guard = guard
        self._tracker = tracker
        self._references = references
        self._lifecycle = lifecycle
        self._watchers = 0
        self._ended = asyncio.Event()

    async def get_agent(self, request: pb.GetAgentConsistencyRequest) -> pb.GetAgentConsistencyResponse:
        """One agent's last seconds.

        Raises:
            BadField: an id is missing or too long, or the window is out of its range.
            UnknownTrack: nothing is remembered of it.
            TrackingUnavailable: the track memory does not answer.
            Unavailable: not ready.
        """
        self._lifecycle.require_ready()
        _check_id("scene_id", request.scene_id)
        _check_id("agent_id", request.agent_id)
        if not 0 <= request.window <= WINDOW:
            raise BadField("window", f"must be within 0 … {WINDOW:g} s")
        held = await self._read(request.scene_id, request.window or DEFAULT_WINDOW, request.agent_id)
        found = await asyncio.to_thread(figures, held.instants.packed)
        return pb.GetAgentConsistencyResponse(instants=self._messages(found, held, range(len(found))))

    async def get_scene(self, request: pb.GetSceneConsistencyRequest) -> pb.GetSceneConsistencyResponse:
        """A scene now. Raises as ``get_agent``."""
        self._lifecycle.require_ready()
        _check_id("scene_id", request.scene_id)
        held = await self._read(request.scene_id, SCENE_WINDOW)
        found = await asyncio.to_thread(figures, held.instants.packed)
        newest: dict[tuple[str, str], int] = {}
        for row, key in enumerate(zip(held.instants.agent_ids, held.instants.series, strict=True)):
            newest[key] = row  # by ascending time: the last one stays
        sums = Sums()
        sums.add(found, held.instants.series, newly_only=False)
        return pb.GetSceneConsistencyResponse(
            latest=self._messages(found, held, [newest[key] for key in sorted(newest)]),
            models=model_messages(sums, self._references),
        )

    async def list_models(self, request: pb.ListModelConsistencyRequest) -> pb.ListModelConsistencyResponse:
        """Sums over the process's life.

        Raises:
            Unavailable: not ready.
        """
        self._lifecycle.require_ready()
        return pb.ListModelConsistencyResponse(models=model_messages(self._tracker.sums(), self._references))

    async def reset_scene(self, request: pb.ResetSceneRequest) -> pb.ResetSceneResponse:
        """Forgets a scene.

        Raises:
            BadField, TrackingUnavailable, Unavailable: as ``get_agent``.
        """
        self._lifecycle.require_ready()
        _check_id("scene_id", request.scene_id)
        try:
            agents = await self._guard.run("reset", lambda: self._store.reset(request.scene_id), PATIENCE)
        except StoreError as error:
            raise TrackingUnavailable(str(error)) from error
        return pb.ResetSceneResponse(agents=agents)

    async def watch_scene(self, request: pb.WatchSceneRequest) -> AsyncIterator[pb.WatchSceneResponse]:
        """Events of a scene until the caller closes the iterator or the server drains.

        Raises:
            BadField, TrackingUnavailable, Unavailable: as ``get_agent``.
            Overloaded: too many watch.
        """
        self._lifecycle.require_ready()
        _check_id("scene_id", request.scene_id)
        if self._watchers >= MAX_WATCHERS:
            raise Overloaded(f"{self._watchers} calls watch already", _WATCH_RETRY)
        self._watchers += 1
        source = self._store.watch(request.scene_id)
        ended = asyncio.ensure_future(self._ended.wait())
        try:
            while not self._ended.is_set():
                coming = asyncio.ensure_future(anext(source))
                try:
                    await asyncio.wait({coming, ended}, return_when=asyncio.FIRST_COMPLETED)
                    if not coming.done():
                        return
                    events, missed = coming.result()
                finally:
                    coming.cancel()
                    await asyncio.gather(coming, return_exceptions=True)
                instants = [pb.InstantConsistency.FromString(event) for event in events]
                yield pb.WatchSceneResponse(instants=instants, missed=missed)
        except StopAsyncIteration:
            return
        except StoreError as error:
            raise TrackingUnavailable(str(error)) from error
        finally:
            self._watchers -= 1
            ended.cancel()
            await source.aclose()

    def end_watching(self) -> None:
        """Ends all that watch."""
        self._ended.set()

    async def _read(self, scene_id: str, window: float, agent_id: str | None = None) -> Remembered:
        try:
            held = await self._guard.run(
                "read", lambda: self._store.read(scene_id, window, agent_id), PATIENCE
            )
        except StoreError as error:
            raise TrackingUnavailable(str(error)) from error
        if not held.agent_ids:
            whose = "this scene" if agent_id is None else "this agent"
            raise UnknownTrack(f"nothing is remembered of {whose}")
        return held

    def _messages(self, found: Figures, held: Remembered, rows: Sequence[int]) -> list[pb.InstantConsistency]:
        of = held.instants
        ids, series = [of.agent_ids[row] for row in rows], [of.series[row] for row in rows]
        return instant_messages(found.rows(rows), ids, series, self._references)


def _check_id(field: str, value: str) -> None:
    if not value:
        raise BadField(field, "is required")
    if len(value) > MAX_ID_LENGTH:
        raise BadField(field, id_too_long(value))
