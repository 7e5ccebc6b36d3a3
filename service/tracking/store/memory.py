"""The track memory of one process."""

import time as clock
from collections import OrderedDict
from collections.abc import AsyncGenerator, Callable, Sequence

from service.tracking.store.base import Event, Recalled, Remembered, Sighting, TrackStore
from service.tracking.store.fanout import Fanout
from service.tracking.store.log_entry import Entry
from service.tracking.store.scene import SceneMemory
from service.tracking.store.track import bundle


class MemoryStore(TrackStore):
    """Remembers in dictionaries; lives on one event loop.

    Args:
        expiry: s without a call after which a scene is forgotten.
        max_agents: of all scenes; beyond it the scenes without a call for the longest time are forgotten.
        now: the clock, s.
    """

    def __init__(self, expiry: float, max_agents: int, now: Callable[[], float] = clock.monotonic) -> None:
        self._expiry = expiry
        self._max_agents = max_agents
        self._now = now
        self._scenes: OrderedDict[str, tuple[SceneMemory, float]] = OrderedDict()
        """With the end of their time on the clock; the next to end first."""
        self._agents = 0
        self._fanout = Fanout()

    async def exchange(
        self, scene_id: str, time: float, sightings: Sequence[Sighting], recall: float | None = None
    ) -> Recalled:
        self._forget_the_expired()
        known = self._take(scene_id)
        scene = SceneMemory() if known is None else known
        outcome = scene.apply(Entry(time, sightings), recall)
        self._scenes[scene_id] = scene, self._now() + self._expiry
        self._agents += len(scene)
        while len(self._scenes) > 1 and max(self._agents, len(self._scenes)) > self._max_agents:
            self._take(next(iter(self._scenes)))
        return Recalled(
            Event.BEGUN if known is None else Event.KEPT,
            outcome.fates,
            outcome.histories,
            bundle(outcome.instants),
            self._fanout.watched(scene_id),
        )

    async def read(self, scene_id: str, window: float, agent_id: str | None = None) -> Remembered:
        self._forget_the_expired()
        if scene_id not in self._scenes:
            return Remembered((), bundle(()))
        ids, instants = await self._scenes[scene_id][0].everything(window, agent_id)
        return Remembered(ids, bundle(instants))

    async def reset(self, scene_id: str) -> int:
        self._forget_the_expired()
        scene = self._take(scene_id)
        return 0 if scene is None else len(scene)

    async def publish(self, scene_id: str, events: Sequence[bytes]) -> None:
        self._fanout.publish(scene_id, events)

    def watch(self, scene_id: str) -> AsyncGenerator[tuple[Sequence[bytes], int], None]:
        return self._fanout.watch(scene_id)

    async def close(self) -> None:
        self._fanout.close()

    def _take(self, scene_id: str) -> SceneMemory | None:
        """A scene out of the memory."""
        scene, _ = self._scenes.pop(scene_id, (None, 0.0))
        self._agents -= 0 if scene is None else len(scene)
        return scene

    def _forget_the_expired(self) -> None:
        now = self._now()
        while self._scenes and next(iter(self._scenes.values()))[1] <= now:
            self._take(next(iter(self._scenes)))
