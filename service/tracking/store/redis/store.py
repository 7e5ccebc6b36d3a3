"""Track memory in Redis 7, shared by all servers that use it.

Redis holds, for each scene, a log of the calls of the last seconds. Each call appends itself and, in the same
round trip, reads what other servers appended since this server's last read. From the log each server builds
the scene's memory in its own process. The memory depends only on the log and its order, so it is the same on
all servers, and a server that starts reads the log once.
"""

import asyncio
import secrets
import struct
import time as clock
from collections import OrderedDict, deque
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from typing import Any

import structlog
from redis.asyncio import Redis
from redis.exceptions import ReadOnlyError

from service.tracking.store.base import ExchangeResult, SceneSnapshot, SceneStatus, TrackStore, TrackUpdate
from service.tracking.store.failures import STORE_FAILURES, reason_of, store_error
from service.tracking.store.log_entry import LogEntry, LogEntryError, pack_log_entry, unpack_log_entry
from service.tracking.store.redis.scripts import SceneKeys, Script
from service.tracking.store.scene import ApplyResult, SceneMemory
from service.tracking.store.track import Instant, join_instants

_log = structlog.get_logger(__name__)

MAX_ENTRIES = 2048
"""Entries of a scene's log; beyond it the oldest are dropped, whatever their time."""
_KEY_BYTES = 8
_LENGTH = struct.Struct("<I")
_STREAM_ENTRIES = 256
_BLOCK_MS = 2000
_WATCHED_MS = 10_000
"""Milliseconds after which a watcher's flag expires unless it is renewed."""


class _Scene:
    """A scene's log as far as this server has read it."""

    def __init__(self) -> None:
        self.memory = SceneMemory()
        self.log = b""
        """Name of the log; empty: none has been read."""
        self.last, self.key = 0, b""
        """Number and key of the last entry that was read."""
        self.lock = asyncio.Lock()
        """Lock of the calls of this scene: what one reads, the next need not."""
        self.users = 0
        """Calls that hold or await the lock."""
        self.used = 0.0
        """Time of the last use on the clock, s."""
        self.agents = 0
        """Number of agents after the last use."""
        self.lost = False
        """True if the known log is gone and no call has reported it yet."""
        self.unreported: list[Instant] = []
        """Instants from this server's own entries whose replies were lost, until a call reports them."""
        self._times: deque[tuple[int, float]] = deque()
        """Number and time of each entry, in order."""

    @property
    def needed(self) -> int:
        """Number of the first entry that the memory still needs."""
        while self._times and self._times[0][1] < self.memory.cut:
            self._times.popleft()
        return self._times[0][0] if self._times else self.last + 1

    def apply(self, number: int, key: bytes, entry: LogEntry, history_s: float | None = None) -> ApplyResult:
        """Apply the next entry."""
        result = self.memory.apply(entry, history_s)
        if result.restarted:  # the clock was set back: by it, the earlier entries would never become old
            self._times.clear()
        self._times.append((number, entry.time))
        self.skip(number, key)
        return result

    def skip(self, number: int, key: bytes) -> None:
        """Pass over the next entry."""
        self.last, self.key = number, key

    def clear(self) -> None:
        """Discard everything that was read."""
        self.memory = SceneMemory()
        self._times.clear()
        self.log, self.last, self.key = b"", 0, b""


class RedisStore(TrackStore):
    """Store in a single Redis server, behind Sentinels, or in a cluster.

    Args:
        client: client from ``connection.connect``, for calls.
        watch_client: client for watchers, each of which holds a connection.
        expiry: seconds without a call after which a scene is deleted.
        max_agents: agents of all scenes in this process, at most; beyond it the least recently used scenes
            are dropped here and read again at their next call.
        now: clock, s.
    """

    def __init__(
        self,
        client: Any,
        watch_client: Any,
        expiry: float,
        max_agents: int,
        now: Callable[[], float] = clock.monotonic,
    ) -> None:
        self._client = client
        self._watch_client = watch_client
        self._expiry_ms = round(expiry * 1000)
        self._max_agents = max_agents
        self._now = now
        self._scenes: OrderedDict[str, _Scene] = OrderedDict()
        """Least recently used first."""
        self._agents = 0
        """Number of agents of all these scenes."""
        self._unanswered: OrderedDict[bytes, None] = OrderedDict()
        """Keys of this server's entries that may or may not have been appended."""
        self._append = Script("append.lua")
        self._publish = Script("publish.lua")

    async def exchange(
        self, scene_id: str, time: float, updates: Sequence[TrackUpdate], history_s: float | None = None
    ) -> ExchangeResult:
        entry = LogEntry(time, updates)
        key = secrets.token_bytes(_KEY_BYTES)
        async with self._locked(scene_id) as scene:
            self._unanswered[key] = None
            if len(self._unanswered) > MAX_ENTRIES:
                self._unanswered.popitem(last=False)
            watched = await self._call(scene_id, scene, key + pack_log_entry(entry), key)
            del self._unanswered[key]
            is_new = scene.last == 0
            result = scene.apply(scene.last + 1, key, entry, history_s)
            status = SceneStatus.LOST if scene.lost else SceneStatus.NEW if is_new else SceneStatus.KEPT
            instants = join_instants([*scene.unreported, *result.instants])
            scene.lost, scene.unreported = False, []
        return ExchangeResult(
            status, result.track_statuses, result.histories, instants, watched, result.behind_s
        )

    async def read(self, scene_id: str, window: float, agent_id: str | None = None) -> SceneSnapshot:
        async with self._locked(scene_id) as scene:
            await self._call(scene_id, scene)
            memory = scene.memory
        # Without the lock: other calls of the scene need not wait for this
        ids, instants = await memory.snapshot(window, agent_id)
        return SceneSnapshot(ids, join_instants(instants))

    async def reset(self, scene_id: str) -> int:
        async with self._locked(scene_id) as scene:
            await self._call(scene_id, scene)
            agents = len(scene.memory)
            await self._client.delete(SceneKeys(scene_id).log)
            scene.clear()
            return agents

    async def ping(self) -> None:
        await self._client.ping()

    async def publish(self, scene_id: str, events: Sequence[bytes]) -> None:
        keys = SceneKeys(scene_id)
        packed = b"".join(_LENGTH.pack(len(event)) + event for event in events)
        await self._publish.run(
            self._client,
            [keys.events, keys.published],
            [self._expiry_ms, _STREAM_ENTRIES, len(events), packed],
        )

    async def watch(self, scene_id: str) -> AsyncGenerator[tuple[Sequence[bytes], int], None]:
        keys = SceneKeys(scene_id)
        renewal: asyncio.Task[None] | None = None
        try:
            entry_id, seen = b"0-0", 0
            for newest, fields in await self._watch_client.xrevrange(keys.events, count=1):
                entry_id, seen = newest, int(fields[b"last"])
            await self._watch_client.set(keys.watched, 1, px=_WATCHED_MS)
            renewal = asyncio.create_task(self._renew(keys))  # independent of how fast events are consumed
            yield (), 0
            while True:
                streams = await self._watch_client.xread({keys.events: entry_id}, block=_BLOCK_MS)
                if renewal.done():
                    renewal.result()  # raises: the renewal ends only by a bug
                for _, entries in streams or ():
                    for newest, fields in entries:
                        events, last = _unpack_events(fields[b"events"]), int(fields[b"last"])
                        # The count starts again when nothing was published until it expired
                        missed = max(last - len(events) - seen, 0) if last > seen else 0
                        entry_id, seen = newest, last
                        yield events, missed
        except STORE_FAILURES as error:
            raise store_error(reason_of(error)) from error
        finally:
            if renewal is not None:
                renewal.cancel()
                await asyncio.gather(renewal, return_exceptions=True)

    async def _renew(self, keys: SceneKeys) -> None:
        while True:
            await asyncio.sleep(_WATCHED_MS / 5000)
            with suppress(*STORE_FAILURES):  # the reader will notice the failure
                await self._watch_client.set(keys.watched, 1, px=_WATCHED_MS)

    async def close(self) -> None:
        await self._client.aclose()
        await self._watch_client.aclose()

    @asynccontextmanager
    async def _locked(self, scene_id: str) -> AsyncGenerator[_Scene, None]:
        """Hold the lock of a scene."""
        scene = self._scenes.setdefault(scene_id, _Scene())
        self._scenes.move_to_end(scene_id)
        scene.users += 1
        try:
            async with scene.lock:
                if self._now() - scene.used > self._expiry_ms / 1000:
                    scene.clear()  # in Redis it has expired too, or another server continues it
                yield scene
        finally:
            scene.users -= 1
            scene.used = self._now()
            self._agents += len(scene.memory) - scene.agents
            scene.agents = len(scene.memory)
            self._make_room()

    def _make_room(self) -> None:
        while self._agents > self._max_agents or len(self._scenes) > self._max_agents:
            unused = next((name for name, scene in self._scenes.items() if not scene.users), None)
            if unused is None:
                return
            self._agents -= self._scenes.pop(unused).agents

    async def _call(self, scene_id: str, scene: _Scene, entry: bytes = b"", key: bytes = b"") -> bool:
        """Read what other servers appended to the log, then append an entry, if given.

        Returns:
            Whether the scene has a watcher.
        """
        keys = SceneKeys(scene_id)
        arguments: list[str | bytes | int] = [
            scene.log,
            scene.last,
            scene.key,
            entry,
            key,
            scene.needed,
            self._expiry_ms,
            MAX_ENTRIES,
        ]
        try:
            reply = await self._append.run(self._client, [keys.log, keys.watched], arguments)
        except ReadOnlyError:
            # The server at this address has become a replica: close the connections, to find the new master
            if isinstance(self._client, Redis):
                await self._client.connection_pool.disconnect(inuse_connections=False)
            raise
        log, last, continues, same, watched, entries = reply
        if not continues:
            scene.lost = scene.lost or (bool(scene.log) and not same)
            scene.clear()
        try:
            for number, packed in enumerate(entries, start=last - len(entries) + 1):
                scene.unreported.extend(self._apply_packed(scene, number, packed))
                if len(entries) > 1:
                    await asyncio.sleep(0)  # a whole log takes a while, and other calls wait
        except BaseException:
            scene.clear()  # the log is read again from its start, so that no entry is applied twice
            raise
        scene.log = log if entry or last else b""
        return bool(watched)

    def _apply_packed(self, scene: _Scene, number: int, packed: bytes) -> list[Instant]:
        """Apply an entry of the log and return the instants that no call has reported."""
        key = packed[:_KEY_BYTES]
        try:
            result = scene.apply(number, key, unpack_log_entry(packed[_KEY_BYTES:]))
        except LogEntryError as error:
            _log.warning("entry of a scene's log skipped", why=str(error))
            scene.skip(number, key)
            return []
        if self._unanswered.pop(key, self) is self:  # another server's entry, which reports it itself
            return []
        return result.instants


def _unpack_events(packed: bytes) -> list[bytes]:
    events, at = [], 0
    while at < len(packed):
        (length,) = _LENGTH.unpack_from(packed, at)
        at += _LENGTH.size
        events.append(packed[at : at + length])
        at += length
    return events
