"""Track memory within one process."""

import time as clock
from collections import OrderedDict
from collections.abc import AsyncGenerator, Callable, Sequence

from service.tracking.store.base import ExchangeResult, SceneSnapshot, SceneStatus, TrackStore, TrackUpdate
from service.tracking.store.fanout import Fanout
from service.tracking.store.log_entry import LogEntry
from service.tracking.store.scene import SceneMemory
from service.tracking.store.track import join_instants


class MemoryStore(TrackStore):
    """Store in dictionaries; used on one event loop.

    Args:
        expiry: seconds without a call after which a scene is deleted.
        max_agents: agents of all scenes, at most; beyond it the least recently used scenes are deleted.
        now: clock, s.
    """

    def __init__(self, expiry: float, max_agents: int, now: Callable[[], float] = clock.monotonic) -> None:
        self._expiry = expiry
        self._max_agents = max_agents
        self._now = now
        self._scenes: OrderedDict[str, tuple[SceneMemory, float]] = OrderedDict()
        """Scenes with the times at which they expire, ascending."""
        self._agents = 0
        self._fanout = Fanout()

    async def exchange(
        self, scene_id: str, time: float, updates: Sequence[TrackUpdate], history_s: float | None = None
    ) -> ExchangeResult:
        self._delete_expired()
        known = self._pop(scene_id)
        scene = SceneMemory() if known is None else known
        result = scene.apply(LogEntry(time, updates), history_s)
        self._scenes[scene_id] = scene, self._now() + self._expiry
        self._agents += len(scene)
        while len(self._scenes) > 1 and max(self._agents, len(self._scenes)) > self._max_agents:
            self._pop(next(iter(self._scenes)))
        return ExchangeResult(
            SceneStatus.NEW if known is None else SceneStatus.KEPT,
            result.track_statuses,
            result.histories,
            join_instants(result.instants),
            self._fanout.watched(scene_id),
            result.behind_s,
        )

    async def read(self, scene_id: str, window: float, agent_id: str | None = None) -> SceneSnapshot:
        self._delete_expired()
        if scene_id not in self._scenes:
            return SceneSnapshot((), join_instants(()))
        ids, instants = await self._scenes[scene_id][0].snapshot(window, agent_id)
        return SceneSnapshot(ids, join_instants(instants))

    async def reset(self, scene_id: str) -> int:
        self._delete_expired()
        scene = self._pop(scene_id)
        return 0 if scene is None else len(scene)

    async def publish(self, scene_id: str, events: Sequence[bytes]) -> None:
        self._fanout.publish(scene_id, events)

    def watch(self, scene_id: str) -> AsyncGenerator[tuple[Sequence[bytes], int], None]:
        return self._fanout.watch(scene_id)

    async def close(self) -> None:
        self._fanout.close()

    def _pop(self, scene_id: str) -> SceneMemory | None:
        """Remove and return a scene."""
        scene, _ = self._scenes.pop(scene_id, (None, 0.0))
        self._agents -= 0 if scene is None else len(scene)
        return scene

    def _delete_expired(self) -> None:
        now = self._now()
        while self._scenes and next(iter(self._scenes.values()))[1] <= now:
            self._pop(next(iter(self._scenes)))
