"""Delivery of frames to the watchers of scenes within one process."""

import asyncio
from collections import deque
from collections.abc import AsyncGenerator
from concurrent.futures import Executor
from dataclasses import dataclass

from cab.forecast.v1 import scene_service_pb2 as pb
from service.scenes.shared_message import SharedMessage
from service.telemetry.metrics import Metrics

MAX_WAITING = 10
"""Max number of frames that wait for a slow watcher: a second at 10 Hz."""
_COPIES = 4
"""Size of a frame in memory, with its encodings, in sizes of its protobuf."""

Event = pb.WatchForecastsResponse | SharedMessage


@dataclass(frozen=True)
class PublishedMap:
    """A map for watchers."""

    digest: bytes
    message: SharedMessage


@dataclass(frozen=True)
class PublishedFrame:
    """A frame for watchers, and the map that they need to see it."""

    shadow: bool
    message: SharedMessage
    map: PublishedMap | None

    @property
    def size(self) -> int:
        """Bytes that the frame needs about in memory."""
        return _COPIES * self.message.size


class _Watcher:
    def __init__(self) -> None:
        self.frames: deque[PublishedFrame] = deque()
        self.size = 0
        self.dropped = 0
        self.ready = asyncio.Event()

    def add(self, frame: PublishedFrame, max_bytes: int) -> int:
        """Queue a frame; return how many older ones were dropped for it."""
        self.frames.append(frame)
        self.size += frame.size
        dropped = 0
        while len(self.frames) > 1 and (len(self.frames) > MAX_WAITING or self.size > max_bytes):
            self.size -= self.frames.popleft().size
            dropped += 1
        self.dropped += dropped
        self.ready.set()
        return dropped

    async def take(self) -> tuple[PublishedFrame, int]:
        """Return the oldest frame, and the number of frames that were dropped before it."""
        await self.ready.wait()
        frame, dropped = self.frames.popleft(), self.dropped
        self.size -= frame.size
        self.dropped = 0
        if not self.frames:
            self.ready.clear()
        return frame, dropped


class _Scene:
    def __init__(self) -> None:
        self.watchers: set[_Watcher] = set()
        self.newest: dict[bool, PublishedFrame] = {}
        """Newest frame of the requested and of the shadow model."""


class FrameFanout:
    """Watchers by scene; a slow one loses the oldest frames and delays nobody. Used on one event loop."""

    def __init__(self, max_bytes: int, metrics: Metrics, threads: Executor) -> None:
        """
        Args:
            max_bytes: size of all frames that wait for slow watchers, at most; one frame may always wait.
            metrics: count the frames that watchers lose.
            threads: executor that encodes frames.
        """
        self.threads = threads
        self.changed = asyncio.Event()
        """Event that is set whenever a scene gets its first watcher or loses its last one."""
        self._max_bytes = max_bytes
        self._metrics = metrics
        self._scenes: dict[str, _Scene] = {}
        self._watchers = 0

    @property
    def watched(self) -> frozenset[str]:
        """The scenes with a watcher."""
        return frozenset(self._scenes)

    def is_watched(self, scene_id: str) -> bool:
        """Return whether a scene has a watcher."""
        return scene_id in self._scenes

    def map_of(self, scene_id: str, digest: bytes) -> PublishedMap | None:
        """Return the map with a digest, if a newest frame of the scene has it."""
        scene = self._scenes.get(scene_id)
        for frame in () if scene is None else scene.newest.values():
            if frame.map is not None and frame.map.digest == digest:
                return frame.map
        return None

    def publish(self, scene_id: str, frame: PublishedFrame) -> None:
        """Deliver a frame to the current watchers of its scene."""
        scene = self._scenes.get(scene_id)
        if scene is None:
            return
        scene.newest[frame.shadow] = frame
        share = self._max_bytes // self._watchers
        for watcher in scene.watchers:
            dropped = watcher.add(frame, share)
            if dropped:
                self._metrics.frames_dropped.labels("watcher").inc(dropped)

    async def watch(self, scene_id: str) -> AsyncGenerator[Event, None]:
        """Yield an empty message, then the newest frames and all that follow.

        A map comes before the first frame that has it, and the number of dropped frames before the frame
        that follows them.
        """
        watcher = _Watcher()
        if scene_id not in self._scenes:
            self._scenes[scene_id] = _Scene()
            self.changed.set()
        scene = self._scenes[scene_id]
        scene.watchers.add(watcher)
        self._watchers += 1
        try:
            for newest in scene.newest.values():
                watcher.add(newest, self._max_bytes)
            yield pb.WatchForecastsResponse()
            digest = b""
            while True:
                frame, dropped = await watcher.take()
                if dropped:
                    yield pb.WatchForecastsResponse(dropped=dropped)
                if frame.map is not None and frame.map.digest != digest:
                    digest = frame.map.digest
                    yield frame.map.message
                yield frame.message
        finally:
            self._watchers -= 1
            scene.watchers.discard(watcher)
            if not scene.watchers:
                del self._scenes[scene_id]
                self.changed.set()
