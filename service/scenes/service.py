"""Scene calls, from request message to response message; transports only carry them."""

from collections.abc import AsyncIterator
from contextlib import aclosing, suppress
from typing import TYPE_CHECKING

from cab.forecast.v1 import scene_service_pb2 as pb
from service.access.watchers import Watchers
from service.errors import check_id
from service.lifecycle import Lifecycle
from service.scenes.fanout import Event, FrameFanout
from service.scenes.live import LiveScenes, merged
from service.settings import Settings
from service.tracking.collector import StoreMetrics
from service.tracking.store.base import StoreError

if TYPE_CHECKING:
    from service.scenes.shared import SharedScenes


class SceneService:
    """Live scenes and their forecasts, to look at."""

    def __init__(
        self,
        live: LiveScenes,
        fanout: FrameFanout,
        shared: "SharedScenes | None",
        watchers: Watchers,
        lifecycle: Lifecycle,
    ) -> None:
        """
        Args:
            live: the scenes that were called lately.
            fanout: delivers the frames.
            shared: the scenes of other servers; None: there are none.
            watchers: bound the ``watch_forecasts`` calls, and end them.
            lifecycle: lifecycle of the server.
        """
        self._live = live
        self._fanout = fanout
        self._shared = shared
        self._watchers = watchers
        self._lifecycle = lifecycle

    async def list_scenes(self, request: pb.ListScenesRequest) -> pb.ListScenesResponse:
        """Return the live scenes, the one that was called last first.

        Raises:
            Unavailable: the server is not ready.
        """
        self._lifecycle.require_ready()
        scenes = self._live.summaries()
        if self._shared is not None:
            with suppress(StoreError):  # the guard counts and logs it; this server's own scenes are known
                scenes = merged([*scenes, *await self._shared.summaries()])
        return pb.ListScenesResponse(scenes=scenes)

    async def watch_forecasts(self, request: pb.WatchForecastsRequest) -> AsyncIterator[Event]:
        """Yield what a scene's watchers get until the caller closes the iterator or the server drains.

        Raises:
            BadField: the id is missing or too long.
            Overloaded: there are too many watchers.
            Unavailable: the server is not ready.
        """
        self._lifecycle.require_ready()
        check_id("scene_id", request.scene_id)
        async with self._watchers.watching("WatchForecasts"):
            events = self._watchers.until_ended(self._fanout.watch(request.scene_id))
            async with aclosing(events):
                async for event in events:
                    yield event


def make_shared_scenes(
    settings: Settings, live: LiveScenes, fanout: FrameFanout, metrics: StoreMetrics
) -> "SharedScenes | None":
    """Return the exchange with other servers; None if the settings name no Redis.

    Args:
        settings: the settings.
        live: the scenes that this server was called for.
        fanout: the watchers of this server.
        metrics: receives durations and failures.
    """
    if settings.store == "memory":
        return None
    from service.scenes.shared import SharedScenes  # noqa: PLC0415 - imported only where it is used

    return SharedScenes(settings, live, fanout, metrics)
