"""Behaviour shared by all stores: in-process, a single Redis, and a cluster of six nodes."""

import asyncio
from collections.abc import AsyncIterator, Sequence

import pytest

from service.tracking.store.base import ExchangeResult, SceneStatus, TrackStatus, TrackStore, TrackUpdate
from service.tracking.store.records import COMPLETE, NEWLY, SETTLED, unpack_instants
from tests.service.tracking.store.stores import memory, opened, scene_name
from tests.service.tracking.store.track_updates import MODEL, observation, times, track_update, where


@pytest.fixture(params=["memory", "redis", "cluster"])
async def store(request: pytest.FixtureRequest) -> AsyncIterator[TrackStore]:
    if request.param == "memory":
        yield memory()
        return
    server = request.getfixturevalue(f"redis_{'server' if request.param == 'redis' else 'cluster'}")
    async with opened(server.url) as opened_store:
        yield opened_store


async def replay(store: TrackStore, scene: str, moments: Sequence[float]) -> list[ExchangeResult]:
    return [await store.exchange(scene, t, [track_update(t)]) for t in moments]


def newly(answers: Sequence[ExchangeResult]) -> list[tuple[str, str, float]]:
    """Return the settled instants in order."""
    return [
        (agent_id, model, float(row["time"]))
        for answer in answers
        for row, agent_id, model in zip(
            unpack_instants(answer.instants.packed),
            answer.instants.agent_ids,
            answer.instants.models,
            strict=True,
        )
        if row["flags"] & NEWLY
    ]


async def test_a_scene_from_its_beginning(store: TrackStore) -> None:
    moments = times(15)
    answers = await replay(store, scene_name(), moments)
    assert [answer.scene_status for answer in answers] == [SceneStatus.NEW] + [SceneStatus.KEPT] * 14
    assert [answer.track_statuses for answer in answers] == [[TrackStatus.NEW]] + [[TrackStatus.KEPT]] * 14
    assert newly(answers) == [("a", MODEL, moment) for moment in moments[12:]]
    assert all(list(answer.instants.agent_ids) == ["a"] for answer in answers)
    assert not any(answer.watched or answer.histories for answer in answers)


@pytest.mark.parametrize("name", ["", "}", "{}", "a{b}c", ":", "Kreuzung ⛔ \n\0", "%7B", "x" * 128])
async def test_any_name_will_do(store: TrackStore, name: str) -> None:
    scene = scene_name() + name
    moments = times(13)
    for moment in moments:
        brought = [track_update(moment, name or "a"), track_update(moment, "other", off=9.0)]
        answer = await store.exchange(scene, moment, brought)
    assert sorted(newly([answer])) == sorted((one, MODEL, moments[-1]) for one in (name or "a", "other"))
    held = await store.read(scene, 99.0, name or "a")
    assert list(held.agent_ids) == [name or "a"]
    assert len((await store.read(scene, 99.0)).agent_ids) == 2
    assert await store.reset(scene) == 2


async def test_scenes_are_told_apart(store: TrackStore) -> None:
    one, two = scene_name(), scene_name()
    await replay(store, one, times(12))
    assert newly(await replay(store, two, times(13)[12:])) == []
    assert newly(await replay(store, one, times(13)[12:])) == [("a", MODEL, times(13)[-1])]


async def test_histories(store: TrackStore) -> None:
    scene = scene_name()
    moments = times(6)
    for moment in moments:
        brought = [TrackUpdate("a", b"v", observation(moment, where(moment)))]
        answer = await store.exchange(scene, moment, brought, history_s=1.0)
    assert answer.histories == [b"".join(observation(t, where(t)) for t in moments[-3:])]


async def test_all_that_is_remembered_can_be_read(store: TrackStore) -> None:
    scene = scene_name()
    moments = times(14)
    for moment in moments:
        await store.exchange(
            scene, moment, [track_update(moment, "a"), track_update(moment, "b", model="", off=20.0)]
        )
    held = await store.read(scene, 99.0)
    assert sorted(held.agent_ids) == ["a", "b"]
    assert list(held.instants.agent_ids) == ["a"] * 14  # of the other one nothing was forecast
    rows = unpack_instants(held.instants.packed)
    assert rows["time"].tolist() == list(moments)
    assert (rows["flags"] & (COMPLETE | SETTLED)).tolist() == [0] * 12 + [COMPLETE | SETTLED] * 2
    assert (await store.read(scene, 99.0, "nobody")).agent_ids in ([], ())
    assert (await store.read(scene_name(), 99.0)).agent_ids in ([], ())


async def test_reading_changes_nothing(store: TrackStore) -> None:
    scene = scene_name()
    await replay(store, scene, times(12))
    await store.read(scene, 99.0)
    assert newly(await replay(store, scene, times(13)[12:])) == [("a", MODEL, times(13)[-1])]


async def test_a_scene_that_was_reset_begins_anew(store: TrackStore) -> None:
    scene = scene_name()
    await replay(store, scene, times(12))
    assert await store.reset(scene) == 1
    assert await store.reset(scene) == 0
    (answer,) = await replay(store, scene, times(13)[12:])
    assert (answer.scene_status, answer.track_statuses) == (SceneStatus.NEW, [TrackStatus.NEW])
    assert newly([answer]) == []


async def test_calls_at_once_are_as_calls_in_a_row(store: TrackStore) -> None:
    scene = scene_name()
    moments = times(40)
    answers = await asyncio.gather(*(store.exchange(scene, t, [track_update(t)]) for t in moments))
    assert sorted(newly(answers)) == [("a", MODEL, moment) for moment in moments[12:]]


async def test_those_who_watch_are_told(store: TrackStore) -> None:
    scene = scene_name()
    moment = times(1)[0]
    assert not (await store.exchange(scene, moment, [track_update(moment)])).watched
    source = store.watch(scene)
    async with asyncio.timeout(20):
        assert await anext(source) == ((), 0)
        assert (await store.exchange(scene, moment, [track_update(moment)])).watched
        assert not (await store.exchange(scene_name(), moment, [track_update(moment)])).watched
        await store.publish(scene_name(), [b"of another scene"])
        await store.publish(scene, [b"1", b"2"])
        await store.publish(scene, [b"3"])
        told: list[bytes] = []
        while len(told) < 3:
            events, missed = await anext(source)
            told.extend(events)
            assert missed == 0
    await source.aclose()
    assert told == [b"1", b"2", b"3"]


async def test_who_reads_too_slowly_is_told_what_was_missed(store: TrackStore) -> None:
    scene = scene_name()
    source = store.watch(scene)
    async with asyncio.timeout(60):
        assert await anext(source) == ((), 0)
        await store.publish(scene, [b"first"])
        assert await anext(source) == ([b"first"], 0)
        for number in range(2000):
            await store.publish(scene, [b"%d" % number])
        told, missed = 0, 0
        while told + missed < 2000:
            events, more = await anext(source)
            told += len(events)
            missed += more
    await source.aclose()
    assert missed > 0
    assert told + missed == 2000
    assert events[-1] == b"1999"
