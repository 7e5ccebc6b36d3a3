"""Delivery of events to the watchers of a scene within one process."""

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, Sequence

BACKLOG = 1024
"""Events that are kept for a slow reader."""


class _Reader:
    def __init__(self) -> None:
        self.events: deque[bytes] = deque()
        self.missed = 0
        self.ready = asyncio.Event()

    def add(self, events: Sequence[bytes]) -> None:
        self.events.extend(events)
        while len(self.events) > BACKLOG:
            self.events.popleft()
            self.missed += 1
        self.ready.set()

    def take(self) -> tuple[Sequence[bytes], int]:
        self.ready.clear()
        events, missed = list(self.events), self.missed
        self.events.clear()
        self.missed = 0
        return events, missed


class Fanout:
    """Delivers events to all readers; a slow reader loses the oldest ones and delays nobody."""

    def __init__(self) -> None:
        self._readers: dict[str, set[_Reader]] = {}
        self._closed = asyncio.Event()

    def watched(self, scene_id: str) -> bool:
        """Return whether a scene has a watcher."""
        return scene_id in self._readers

    def publish(self, scene_id: str, events: Sequence[bytes]) -> None:
        """Deliver events to the current watchers of a scene."""
        for reader in self._readers.get(scene_id, ()):
            reader.add(events)

    async def watch(self, scene_id: str) -> AsyncGenerator[tuple[Sequence[bytes], int], None]:
        """Yield events, as ``TrackStore.watch`` does."""
        reader = _Reader()
        self._readers.setdefault(scene_id, set()).add(reader)
        try:
            yield (), 0
            while not self._closed.is_set():
                await reader.ready.wait()
                events, missed = reader.take()
                if events:
                    yield events, missed
        finally:
            readers = self._readers[scene_id]
            readers.discard(reader)
            if not readers:
                del self._readers[scene_id]

    def close(self) -> None:
        """End all watches."""
        self._closed.set()
        for readers in self._readers.values():
            for reader in readers:
                reader.ready.set()
