"""The track memory in Redis 7: shared by all servers that use it.

Redis holds, for each scene, a log of the calls of the last seconds. A call appends itself and gets, in the
same round trip, what other servers appended since this one looked last. From these each server has the
scene's memory at hand: nothing but the log and its order goes into it, so that all servers have the same,
and one that starts reads the log once.
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

from service.tracking.store.base import Event, Recalled, Remembered, Sighting, TrackStore
from service.tracking.store.failures import reason_of, store_error
from service.tracking.store.log_entry import Entry, EntryError, pack_entry, unpack_entry
from service.tracking.store.redis.keys import SceneKeys
from service.tracking.store.redis.scripts import Script
from service.tracking.store.scene import Outcome, SceneMemory
from service.tracking.store.track import Instant, bundle

_log = structlog.get_logger(__name__)

MAX_ENTRIES = 2048
"""Of a scene's log; beyond it the oldest go, whatever their time."""
_KEY_BYTES = 8
_LENGTH = struct.Struct("<I")
_STREAM_ENTRIES = 256
_BLOCK_MS = 2000
_WATCHED_MS = 10_000
"""How long a watcher's sign stands without being renewed."""


class _Scene:
    """A scene's log as far as this server has read it."""

    def __init__(self) -> None:
        self.memory = SceneMemory()
        self.log = b""
        """The log's name; empty: none was read."""
        self.last, self.key = 0, b""
        """Number and key of the last entry that was read."""
        self.lock = asyncio.Lock()
        """One call at a time: what one reads, the next need not."""
        self.users = 0
        """Calls that have it or wait for it."""
        self.used = 0.0
        """When, on the clock, s."""
        self.agents = 0
        """That it had when it was last looked at."""
        self.lost = False
        """Whether the log that was known has gone, and no call was told so yet."""
        self.missed: list[Instant] = []
        """What entries of this server led to of which it had got no answer; no call was told of it yet."""
        self._times: deque[tuple[int, float]] = deque()
        """Number and time of each entry, in order."""

    @property
    def needed(self) -> int:
        """Number of the first entry that is still remembered."""
        while self._times and self._times[0][1] < self.memory.cut:
            self._times.popleft()
        return self._times[0][0] if self._times else self.last + 1

    def apply(self, number: int, key: bytes, entry: Entry, recall: float | None = None) -> Outcome:
        """Goes one entry on."""
        outcome = self.memory.apply(entry, recall)
        if outcome.restarted:  # its clock was ahead: by its time nothing of before would ever be old
            self._times.clear()
        self._times.append((number, entry.time))
        self.skip(number, key)
        return outcome

    def skip(self, number: int, key: bytes) -> None:
        """Goes one entry on that says nothing."""
        self.last, self.key = number, key

    def forget(self) -> None:
        """Begins anew."""
        self.memory = SceneMemory()
        self._times.clear()
        self.log, self.last, self.key = b"", 0, b""


class RedisStore(TrackStore):
    """Remembers in one server, behind Sentinels or in a cluster.

    Args:
        client: of ``connection.connect``, for calls.
        watching: another one, for those who watch: each holds a connection for as long as it does.
        expiry: s without a call after which a scene is forgotten.
        max_agents: of all scenes that this server has at hand; beyond it those not used for the longest time
            are read again when they are.
        now: the clock, s.
    """

    def __init__(
        self,
        client: Any,
        watching: Any,
        expiry: float,
        max_agents: int,
        now: Callable[[], float] = clock.monotonic,
    ) -> None:
        self._client = client
        self._watching = watching
        self._expiry_ms = round(expiry * 1000)
        self._max_agents = max_agents
        self._now = now
        self._scenes: OrderedDict[str, _Scene] = OrderedDict()
        """The longest unused first."""
        self._agents = 0
        """Of all these scenes."""
        self._unanswered: OrderedDict[bytes, None] = OrderedDict()
        """Keys of this server's entries of which it is not known whether they were appended."""
        self._append = Script("append.lua")
        self._publish = Script("publish.lua")

    async def exchange(
        self, scene_id: str, time: float, sightings: Sequence[Sighting], recall: float | None = None
    ) -> Recalled:
        entry = Entry(time, sightings)
        key = secrets.token_bytes(_KEY_BYTES)
        async with self._at_hand(scene_id) as scene:
            self._unanswered[key] = None
            if len(self._unanswered) > MAX_ENTRIES:
                self._unanswered.popitem(last=False)
            watched = await self._call(scene_id, scene, key + pack_entry(entry), key)
            del self._unanswered[key]
            begun = scene.last == 0
            outcome = scene.apply(scene.last + 1, key, entry, recall)
            event = Event.LOST if scene.lost else Event.BEGUN if begun else Event.KEPT
            instants = bundle([*scene.missed, *outcome.instants])
            scene.lost, scene.missed = False, []
        return Recalled(event, outcome.fates, outcome.histories, instants, watched)

    async def read(self, scene_id: str, window: float, agent_id: str | None = None) -> Remembered:
        async with self._at_hand(scene_id) as scene:
            await self._call(scene_id, scene)
            memory = scene.memory
        # Calls of the scene need not wait for this
        ids, instants = await memory.everything(window, agent_id)
        return Remembered(ids, bundle(instants))

    async def reset(self, scene_id: str) -> int:
        async with self._at_hand(scene_id) as scene:
            await self._call(scene_id, scene)
            agents = len(scene.memory)
            await self._client.delete(SceneKeys(scene_id).log)
            scene.forget()
            return agents

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
        renewing: asyncio.Task[None] | None = None
        try:
            entry_id, seen = b"0-0", 0
            for newest, fields in await self._watching.xrevrange(keys.events, count=1):
                entry_id, seen = newest, int(fields[b"last"])
            await self._watching.set(keys.watched, 1, px=_WATCHED_MS)
            renewing = asyncio.create_task(self._renew(keys))  # however slowly the events are taken
            yield (), 0
            while True:
                streams = await self._watching.xread({keys.events: entry_id}, block=_BLOCK_MS)
                for _, entries in streams or ():
                    for newest, fields in entries:
                        events, last = _unpack_events(fields[b"events"]), int(fields[b"last"])
                        # Counting begins anew when nothing was published for as long as it is kept
                        missed = max(last - len(events) - seen, 0) if last > seen else 0
                        entry_id, seen = newest, last
                        yield events, missed
        except Exception as error:
            raise store_error(reason_of(error)) from error
        finally:
            if renewing is not None:
                renewing.cancel()
                await asyncio.gather(renewing, return_exceptions=True)

    async def _renew(self, keys: SceneKeys) -> None:
        while True:
            await asyncio.sleep(_WATCHED_MS / 5000)
            with suppress(Exception):  # the reader finds out what there is to be told
                await self._watching.set(keys.watched, 1, px=_WATCHED_MS)

    async def close(self) -> None:
        await self._client.aclose()
        await self._watching.aclose()

    @asynccontextmanager
    async def _at_hand(self, scene_id: str) -> AsyncGenerator[_Scene, None]:
        """A scene, for one call at a time."""
        scene = self._scenes.setdefault(scene_id, _Scene())
        self._scenes.move_to_end(scene_id)
        scene.users += 1
        try:
            async with scene.lock:
                if self._now() - scene.used > self._expiry_ms / 1000:
                    scene.forget()  # in Redis it has gone as well, or another server goes on with it
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
        """Appends an entry, if one is given, after all that others appended was read.

        Returns:
            Whether somebody watches.
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
            # What is behind the address is another server's replica by now: the next call connects anew
            if isinstance(self._client, Redis):
                await self._client.connection_pool.disconnect(inuse_connections=False)
            raise
        log, last, continues, same, watched, entries = reply
        if not continues:
            scene.lost = scene.lost or (bool(scene.log) and not same)
            scene.forget()
        try:
            for number, packed in enumerate(entries, start=last - len(entries) + 1):
                scene.missed.extend(self._read(scene, number, packed))
                if len(entries) > 1:
                    await asyncio.sleep(0)  # a log of seconds takes a while, and other calls wait
        except BaseException:
            scene.forget()  # it is read again: nothing of it may be taken twice
            raise
        scene.log = log if entry or last else b""
        return bool(watched)

    def _read(self, scene: _Scene, number: int, packed: bytes) -> list[Instant]:
        key = packed[:_KEY_BYTES]
        try:
            outcome = scene.apply(number, key, unpack_entry(packed[_KEY_BYTES:]))
        except EntryError as error:
            _log.warning("an entry of a scene's log was left out", why=str(error))
            scene.skip(number, key)
            return []
        if self._unanswered.pop(key, self) is self:
            return []
        return outcome.instants


def _unpack_events(packed: bytes) -> list[bytes]:
    events, at = [], 0
    while at < len(packed):
        (length,) = _LENGTH.unpack_from(packed, at)
        at += _LENGTH.size
        events.append(packed[at : at + length])
        at += length
    return events
