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
from contextlib import asynccontextmanager
from typing import Any

import structlog

from service.history.entry import Entry, EntryError, pack_entry, unpack_entry
from service.history.failures import reason_of, store_error
from service.history.keys import SceneKeys
from service.history.scene import Outcome, SceneMemory
from service.history.scripts import Script
from service.history.store import Event, Recalled, Remembered, Sighting, TrackStore
from service.history.track import Instant, bundle

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
        self._times: deque[tuple[int, float]] = deque()
        """Number and time of each entry, in order."""

    @property
    def needed(self) -> int:
        """Number of the first entry that is still remembered."""
        while self._times and self._times[0][1] < self.memory.cut:
            self._times.popleft()
        return self._times[0][0] if self._times else self.last + 1

    def apply(self, number: int, entry: Entry, recall: float | None = None) -> Outcome:
        """Goes one entry on."""
        outcome = self.memory.apply(entry, recall)
        self._times.append((number, entry.time))
        return outcome

    def forget(self) -> None:
        """Begins anew."""
        self.memory = SceneMemory()
        self._times.clear()
        self.last, self.key = 0, b""


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
            before = scene.last
            self._unanswered[key] = None
            if len(self._unanswered) > MAX_ENTRIES:
                self._unanswered.popitem(last=False)
            continues, watched, missed = await self._call(scene_id, scene, key + pack_entry(entry), key)
            del self._unanswered[key]
            outcome = scene.apply(scene.last, entry, recall)
        event = Event.KEPT
        if not continues:
            event = Event.LOST if before else Event.KEPT if scene.last > 1 else Event.BEGUN
        return Recalled(
            event, outcome.fates, outcome.histories, bundle([*missed, *outcome.instants]), watched
        )

    async def read(self, scene_id: str, agent_id: str | None = None) -> Remembered:
        async with self._at_hand(scene_id) as scene:
            await self._call(scene_id, scene)
            ids, instants = await scene.memory.everything(agent_id)
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
        try:
            entry_id, seen = b"0-0", 0
            for newest, fields in await self._watching.xrevrange(keys.events, count=1):
                entry_id, seen = newest, int(fields[b"last"])
            await self._watching.set(keys.watched, 1, px=_WATCHED_MS)
            yield (), 0
            while True:
                await self._watching.set(keys.watched, 1, px=_WATCHED_MS)
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

    async def open(self) -> None:
        """Nothing to be done: connections are made when they are needed."""

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

    async def _call(
        self, scene_id: str, scene: _Scene, entry: bytes = b"", key: bytes = b""
    ) -> tuple[bool, bool, list[Instant]]:
        """Appends an entry, if one is given, after all that others appended was read.

        Returns:
            Whether the log was the one that is at hand; whether somebody watches; what entries of this server
            led to of which it had got no answer.
        """
        keys = SceneKeys(scene_id)
        last, continues, watched, entries = await self._append.run(
            self._client,
            [keys.log, keys.watched],
            [scene.last, scene.key, entry, key, scene.needed, self._expiry_ms, MAX_ENTRIES],
        )
        if not continues:
            scene.forget()
        missed: list[Instant] = []
        for number, packed in enumerate(entries, start=last - len(entries) + 1):
            missed.extend(self._read(scene, number, packed))
            if len(entries) > 1:
                await asyncio.sleep(0)  # a log of seconds takes a while, and other calls wait
        scene.last = last + 1 if entry else last
        scene.key = key if entry else entries[-1][:_KEY_BYTES] if entries else scene.key
        return bool(continues), bool(watched), missed

    def _read(self, scene: _Scene, number: int, packed: bytes) -> list[Instant]:
        try:
            outcome = scene.apply(number, unpack_entry(packed[_KEY_BYTES:]))
        except EntryError as error:
            _log.warning("an entry of a scene's log was left out", why=str(error))
            return []
        if self._unanswered.pop(packed[:_KEY_BYTES], self) is self:
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
