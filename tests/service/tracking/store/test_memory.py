"""Expiry and bounds of the in-process store; what all stores share is in test_base."""

from service.tracking.store.base import SceneStatus
from service.tracking.store.memory import MemoryStore
from tests.service.tracking.store.track_updates import START, track_update


class Clock:
    """Clock that a test sets."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


async def call(store: MemoryStore, scene: str, agents: int = 1) -> SceneStatus:
    """Make one call of a scene, with agents of its own."""
    updates = [track_update(START, f"{number}") for number in range(agents)]
    return (await store.exchange(scene, START, updates)).scene_status


async def test_a_scene_expires_unless_it_is_called() -> None:
    clock = Clock()
    store = MemoryStore(expiry=10.0, max_agents=100, now=clock)
    await call(store, "called")
    await call(store, "left")
    clock.now = 9.0
    assert await call(store, "called") is SceneStatus.KEPT
    clock.now = 10.0
    assert (await store.read("left", 99.0)).agent_ids == ()
    assert await call(store, "left") is SceneStatus.NEW
    clock.now = 18.9
    assert await call(store, "called") is SceneStatus.KEPT
    clock.now = 100.0
    assert await store.reset("called") == 0


async def test_the_least_recently_called_scenes_make_room() -> None:
    store = MemoryStore(expiry=10.0, max_agents=5, now=Clock())
    for scene in ("a", "b"):
        await call(store, scene, agents=2)
    await call(store, "a", agents=2)
    await call(store, "c", agents=2)
    assert [len((await store.read(scene, 99.0)).agent_ids) for scene in "abc"] == [2, 0, 2]
    await call(store, "d", agents=9)
    assert [len((await store.read(scene, 99.0)).agent_ids) for scene in "abcd"] == [0, 0, 0, 9]


async def test_scenes_without_agents_are_bounded_too() -> None:
    store = MemoryStore(expiry=10.0, max_agents=3, now=Clock())
    for number in range(10):
        await call(store, f"{number}", agents=0)
    assert len(store._scenes) == 3
