"""Scene calls, from request message to response message; transports only carry them."""

from collections.abc import AsyncIterator
from contextlib import aclosing

from cab.forecast.v1 import scene_service_pb2 as pb
from service.access.watchers import Watchers
from service.errors import check_id
from service.lifecycle import Lifecycle
from service.scenes.fanout import Event, FrameFanout
from service.scenes.live import LiveScenes


class SceneService:
    """Live scenes and their forecasts, to look at."""

    def __init__(
        self, live: LiveScenes, fanout: FrameFanout, watchers: Watchers, lifecycle: Lifecycle
    ) -> None:
        """
        Args:
            live: the scenes that were called lately.
            fanout: delivers the frames.
            watchers: bound the ``watch_forecasts`` calls, and end them.
            lifecycle: lifecycle of the server.
        """
        self._live = live
        self._fanout = fanout
        self._watchers = watchers
        self._lifecycle = lifecycle

    async def list_scenes(self, request: pb.ListScenesRequest) -> pb.ListScenesResponse:
        """Return the live scenes, the one that was called last first.

        Raises:
            Unavailable: the server is not ready.
        """
        self._lifecycle.require_ready()
        return pb.ListScenesResponse(scenes=self._live.summaries())

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
