"""Live scenes of all servers that use one Redis.

Once a second each server tells in one round trip which scenes it was called for and which are watched here,
and learns which are watched elsewhere. Frames of those go to a stream of the scene, which each server with
watchers reads once for all of them. A failure of Redis costs scenes and frames of the other servers, no more.
"""

import asyncio
import secrets
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import Any

import structlog
from google.protobuf.message import DecodeError

from cab.forecast.v1 import scene_service_pb2 as pb
from service.redis_url import parse_address
from service.scenes.fanout import FrameFanout, PublishedFrame, PublishedMap
from service.scenes.live import MAX_SCENES, LiveScenes
from service.scenes.shared_message import SharedMessage, to_protobuf
from service.settings import Settings
from service.tracking.collector import StoreMetrics
from service.tracking.store.base import StoreError
from service.tracking.store.failures import STORE_FAILURES
from service.tracking.store.guard import Guard
from service.tracking.store.redis.connection import connect
from service.tracking.store.redis.scripts import SceneKeys, Script

_log = structlog.get_logger(__name__)

_PERIOD = 1.0
"""Seconds between synchronizations."""
_WATCH_MS = 5000
"""Milliseconds after which a watch that is not renewed expires."""
_FRAMES = 8
"""Number of frames that the stream of a scene keeps."""
_FRAMES_MS = 30_000
"""Milliseconds after which the last frames and maps of a scene expire."""
_BLOCK_MS = 2000
_BUDGET = 2.0
"""Seconds that an operation may take; no forecast waits for one."""
_LIST_BUDGET = 0.5
"""Seconds that a list of the scenes waits for Redis."""
_MAX_OUTSTANDING = 16
"""Number of frames on their way to Redis beyond which further ones are dropped."""
_RETRY = 1.0
"""Seconds until a reader whose connection failed tries again."""
_TIMEOUT = 10.0
"""Seconds of a reader's command; it blocks in Redis for 2 s at most."""
_KEYS = tuple(f"cab:1:scenes:{{scenes}}:{name}" for name in ("summaries", "updated", "watched"))
_PACKAGE = "service.scenes"


class SharedScenes:
    """Exchange of live scenes with other servers. Used on one event loop."""

    def __init__(
        self, settings: Settings, live: LiveScenes, fanout: FrameFanout, metrics: StoreMetrics
    ) -> None:
        """
        Args:
            settings: name the Redis.
            live: the scenes that this server was called for.
            fanout: the watchers of this server.
            metrics: receives durations and failures.
        """
        address = parse_address(settings.store)
        self._client: Any = connect(address, timeout_s=settings.store_timeout_ms / 1000, connections=4)
        self._reading: Any = connect(address, timeout_s=_TIMEOUT, connections=settings.max_watchers)
        self._expiry_ms = round(settings.track_expiry * 1000)
        self._live = live
        self._fanout = fanout
        self._guard = Guard(metrics.observe, metrics.failed, calls="scenes")
        self._server = secrets.token_hex(6)
        """Name of this server among all, without a space."""
        self._sync = Script("sync.lua", _PACKAGE)
        self._put = Script("put_frame.lua", _PACKAGE)
        self._watched_elsewhere: frozenset[str] = frozenset()
        self._known_maps: dict[str, bytes] = {}
        """Digest of the map that Redis has, by scene that is watched elsewhere."""
        self._queue: asyncio.Queue[tuple[str, PublishedFrame]] = asyncio.Queue(_MAX_OUTSTANDING)
        self._readers: dict[str, asyncio.Task[None]] = {}
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Begin to exchange."""
        self._tasks = [
            asyncio.create_task(self._follow(), name="scenes"),
            asyncio.create_task(self._send(), name="frames to Redis"),
        ]

    async def close(self) -> None:
        """End the exchange and release the connections."""
        tasks = [*self._tasks, *self._readers.values()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self._guard.close()
        await self._client.aclose()
        await self._reading.aclose()

    def is_watched(self, scene_id: str) -> bool:
        """Return whether a scene has a watcher at another server."""
        return scene_id in self._watched_elsewhere

    def publish(self, scene_id: str, frame: PublishedFrame) -> bool:
        """Send a frame to the other servers, later; False: it was dropped, because Redis is too slow."""
        try:
            self._queue.put_nowait((scene_id, frame))
        except asyncio.QueueFull:
            return False
        return True

    async def summaries(self) -> list[pb.SceneSummary]:
        """Return the scenes that other servers were called for.

        Raises:
            StoreError: Redis does not answer.
        """
        fields = await self._guard.run("scenes_list", lambda: self._client.hgetall(_KEYS[0]), _LIST_BUDGET)
        own = f"{self._server} "
        found = []
        for field, packed in fields.items():
            if not field.decode().startswith(own):
                with suppress(DecodeError):
                    found.append(pb.SceneSummary.FromString(packed))
        return found

    async def _follow(self) -> None:
        told = 0.0
        while True:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._fanout.changed.wait(), _PERIOD)
            self._fanout.changed.clear()
            self._update_readers()
            summaries = [one for one in self._live.summaries() if one.updated_time > told]
            watched = self._fanout.watched
            if not len(self._live) and not watched:
                continue
            with suppress(StoreError):  # the guard counts and logs it
                await self._exchange(summaries, sorted(watched))
                told = max((one.updated_time for one in summaries), default=told)

    async def _exchange(self, summaries: Sequence[pb.SceneSummary], watched: Sequence[str]) -> None:
        arguments: list[str | bytes | int] = [self._expiry_ms, _WATCH_MS, 4 * MAX_SCENES, len(watched)]
        arguments += [f"{self._server} {scene_id}" for scene_id in watched]
        for one in summaries:
            arguments += [f"{self._server} {one.scene_id}", one.SerializeToString()]
        members = await self._run("scenes_sync", lambda: self._sync.run(self._client, _KEYS, arguments))
        watchers = (member.decode().partition(" ") for member in members)
        elsewhere = frozenset(scene_id for server, _, scene_id in watchers if server != self._server)
        self._watched_elsewhere = elsewhere
        self._known_maps = {name: known for name, known in self._known_maps.items() if name in elsewhere}

    async def _send(self) -> None:
        while True:
            scene_id, frame = await self._queue.get()
            try:
                await self._put_frame(scene_id, frame)
            except StoreError:
                pass  # the guard counts and logs it
            except Exception:  # of one frame, which must not end all that follow
                _log.exception("frame is not sent to other servers", scene_id=scene_id)

    async def _put_frame(self, scene_id: str, frame: PublishedFrame) -> None:
        encoded = await frame.message.encoded(to_protobuf)
        digest, image = b"", b""
        if frame.map is not None:
            digest = frame.map.digest
            if self._known_maps.get(scene_id) != digest:
                image = await frame.map.message.encoded(to_protobuf)
        keys = SceneKeys(scene_id)
        arguments: list[str | bytes | int] = [_FRAMES, _FRAMES_MS, self._server, encoded, image]
        has_map = await self._run(
            "frame_put", lambda: self._put.run(self._client, [keys.frames, keys.map(digest)], arguments)
        )
        self._known_maps[scene_id] = digest if has_map else b""

    def _update_readers(self) -> None:
        """Read the frames of the scenes that are watched here, and of no others."""
        watched = self._fanout.watched
        for scene_id in [name for name in self._readers if name not in watched]:
            self._readers.pop(scene_id).cancel()
        for scene_id in watched - self._readers.keys():
            self._readers[scene_id] = asyncio.create_task(self._read(scene_id), name="read frames")

    async def _read(self, scene_id: str) -> None:
        """Deliver the frames of a scene that other servers make."""
        keys = SceneKeys(scene_id)
        last = b"$"
        while True:
            try:
                streams = await self._reading.xread({keys.frames: last}, block=_BLOCK_MS)
                for _, entries in streams or ():
                    for number, fields in entries:
                        last = number
                        if fields[b"server"] != self._server.encode():
                            await self._deliver(scene_id, fields[b"frame"])
            except STORE_FAILURES as error:
                _log.warning("frames of other servers are not read", error=type(error).__name__)
                await asyncio.sleep(_RETRY)
            except (DecodeError, KeyError):
                _log.warning("frame in Redis is damaged", scene_id=scene_id)

    async def _deliver(self, scene_id: str, packed: bytes) -> None:
        event = await asyncio.to_thread(pb.WatchForecastsResponse.FromString, packed)
        shown = await self._map(scene_id, event.frame.map_digest)
        message = SharedMessage(event, self._fanout.threads)
        self._fanout.publish(scene_id, PublishedFrame(event.frame.shadow, message, shown))

    async def _map(self, scene_id: str, digest: bytes) -> PublishedMap | None:
        """Return the map of a frame, which is read once; None if there is none, or not any more."""
        if not digest:
            return None
        known = self._fanout.map_of(scene_id, digest)
        if known is not None:
            return known
        packed = await self._reading.get(SceneKeys(scene_id).map(digest))
        if packed is None:
            return None
        event = pb.WatchForecastsResponse.FromString(packed)
        return PublishedMap(digest, SharedMessage(event, self._fanout.threads))

    async def _run(self, op: str, call: Callable[[], Awaitable[Any]]) -> Any:
        return await self._guard.run(op, call, _BUDGET)
