"""Redis store: several servers on one log, and faults of the log."""

import asyncio
import random
from collections.abc import AsyncIterator, Sequence

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from redis import exceptions as redis_errors

from loadtest.redis_servers import Process, single
from service.tracking.store.base import ExchangeResult, SceneStatus, StoreError, TrackStatus, TrackStore
from service.tracking.store.records import NEWLY, unpack_instants
from service.tracking.store.redis.scripts import SceneKeys
from service.tracking.store.redis.store import MAX_ENTRIES, RedisStore
from tests.service.tracking.store.stores import memory, opened, scene_name
from tests.service.tracking.store.track_updates import START, times, track_update


@pytest.fixture
async def store(redis_server: Process) -> AsyncIterator[RedisStore]:
    async with opened(redis_server.url) as one:
        yield one


@pytest.fixture
async def other(redis_server: Process) -> AsyncIterator[RedisStore]:
    """Open the store of another server."""
    async with opened(redis_server.url) as one:
        yield one


def rows(answers: Sequence[ExchangeResult]) -> list[bytes]:
    """Return the settled instants, by time and agent."""
    found = []
    for answer in answers:
        told = answer.instants
        for row, agent_id, model in zip(
            unpack_instants(told.packed), told.agent_ids, told.models, strict=True
        ):
            if row["flags"] & NEWLY:
                found.append((float(row["time"]), agent_id, model, row.tobytes()))
    return [row for *_, row in sorted(found)]


async def replay(stores: Sequence[TrackStore], scene: str, moments: Sequence[float]) -> list[ExchangeResult]:
    """Make calls to the stores in turn."""
    return [
        await stores[number % len(stores)].exchange(
            scene, t, [track_update(t), track_update(t, "b", off=9.0, miss=1.0)]
        )
        for number, t in enumerate(moments)
    ]


def number(server: Process, *words: str) -> int:
    """Run a command and return its reply, a number."""
    answer = server.command(*words)
    assert isinstance(answer, int)
    return answer


async def lose_the_answer(
    store: RedisStore, scene: str, moments: Sequence[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Make calls that reach Redis but whose replies are lost."""
    run = store._append.run

    async def lose(*arguments: object) -> object:
        await run(*arguments)  # type: ignore[arg-type]
        raise TimeoutError

    with monkeypatch.context() as patched:
        patched.setattr(store._append, "run", lose)
        with pytest.raises(TimeoutError):
            await replay([store], scene, moments)


async def test_two_servers_in_turn_are_as_one(store: RedisStore, other: RedisStore) -> None:
    rng = random.Random(3)
    moments = sorted(times(60), key=lambda t: t + rng.uniform(0, 1.5))
    scene = scene_name()
    together = await replay([store, other, other, store, store], scene, moments)
    assert rows(together) == rows(await replay([memory()], scene, moments))
    assert (await store.read(scene, 99.0)).instants == (await other.read(scene, 99.0)).instants


async def test_a_server_that_starts_midway_knows_all(store: RedisStore, redis_server: Process) -> None:
    moments = times(30)
    scene = scene_name()
    answers = await replay([store], scene, moments[:20])
    async with opened(redis_server.url) as fresh:
        answers += await replay([fresh], scene, moments[20:])
    assert [answer.scene_status for answer in answers] == [SceneStatus.NEW] + [SceneStatus.KEPT] * 29
    assert rows(answers) == rows(await replay([memory()], scene, moments))


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(
            st.integers(0, 1),
            st.integers(0, 40),
            st.sampled_from(["a", "b"]),
            st.sampled_from(["m@1", "n@1"]),
            st.sampled_from([0.0, 0.0, 0.0, 0.03, 300.0]),
            st.sampled_from([b"v", b"v", b"v", b"p"]),
        ),
        max_size=50,
    )
)
async def test_whatever_comes_both_memories_say_the_same(
    store: RedisStore,
    other: RedisStore,
    calls: list[tuple[int, int, str, str, float, bytes]],
) -> None:
    scene, alone = scene_name(), memory()
    for server, number, agent_id, model, off, kind in calls:
        t = START + 0.5 * number + (off if off < 1 else 0.0)
        brought = [track_update(t, agent_id, model=model, off=off, agent_type=kind)]
        expected = await alone.exchange(scene, t, brought, history_s=3.0)
        answer = await (store, other)[server].exchange(scene, t, brought, history_s=3.0)
        assert (answer.track_statuses, answer.histories) == (expected.track_statuses, expected.histories)
        assert answer.instants == expected.instants
    assert (await other.read(scene, 99.0)).instants == (await alone.read(scene, 99.0)).instants


async def test_one_round_trip_a_call(redis_server: Process, store: RedisStore) -> None:
    scene = scene_name()
    await replay([store], scene, times(2))

    def commands() -> dict[str, int]:
        lines = redis_server.text("info", "commandstats").splitlines()
        counts = (line.split("_", 1)[1].split(":calls=") for line in lines if line.startswith("cmdstat_"))
        return {name: int(rest.split(",")[0]) for name, rest in counts}

    before = commands()
    await replay([store], scene, times(22)[2:])
    after = commands()
    # What the script itself calls is counted there, too
    inside = {"hmget", "hget", "hset", "hdel", "pexpire", "exists", "info"}
    asked = {name: count - before.get(name, 0) for name, count in after.items() if name not in inside}
    assert {name: count for name, count in asked.items() if count} == {"evalsha": 20}


async def test_a_flushed_script_is_loaded_again(redis_server: Process, store: RedisStore) -> None:
    scene = scene_name()
    answers = await replay([store], scene, times(12))
    redis_server.command("script", "flush")
    answers += await replay([store], scene, times(13)[12:])
    assert len(rows(answers)) == 2


async def test_a_log_that_is_gone(redis_server: Process, store: RedisStore, other: RedisStore) -> None:
    scene = scene_name()
    await replay([store, other], scene, times(12))
    redis_server.command("del", SceneKeys(scene).log)
    (answer,) = await replay([store], scene, times(13)[12:])
    assert (answer.scene_status, answer.track_statuses) == (
        SceneStatus.LOST,
        [TrackStatus.NEW, TrackStatus.NEW],
    )
    assert rows([answer]) == []
    (answer,) = await replay([other], scene, times(14)[13:])
    assert (answer.scene_status, answer.track_statuses) == (
        SceneStatus.LOST,
        [TrackStatus.KEPT, TrackStatus.KEPT],
    )


async def test_a_reset_by_another_server_is_noticed(store: RedisStore, other: RedisStore) -> None:
    scene = scene_name()
    await replay([store, other], scene, times(12))
    assert await other.reset(scene) == 2
    (answer,) = await replay([store], scene, times(13)[12:])
    assert (answer.scene_status, answer.track_statuses) == (
        SceneStatus.LOST,
        [TrackStatus.NEW, TrackStatus.NEW],
    )


async def test_a_log_that_lost_its_end(redis_server: Process, store: RedisStore, other: RedisStore) -> None:
    """This happens when a replica takes over that has not received the last entries."""
    scene = scene_name()
    log = SceneKeys(scene).log
    await replay([store], scene, times(12))
    redis_server.command("hset", log, "l", "10")
    redis_server.command("hdel", log, "11", "k11", "12", "k12")
    await replay([other], scene, times(16)[14:15])  # another entry takes the number 11
    await replay([other], scene, times(17)[15:16])  # and 12
    (answer,) = await replay([store], scene, times(17)[16:])
    assert (answer.scene_status, answer.track_statuses) == (
        SceneStatus.LOST,
        [TrackStatus.KEPT, TrackStatus.KEPT],
    )
    assert (await store.read(scene, 99.0)).instants == (await other.read(scene, 99.0)).instants


@pytest.mark.parametrize(
    "foreign",
    [
        ("set", "hello"),
        ("rpush", "hello"),
        ("hset", "hello", "world"),
        ("hset", "f", "1", "l", "hello"),
        ("hset", "f", "-5", "l", "3"),
        ("hset", "f", "1", "l", "1e300"),
    ],
)
async def test_something_else_in_its_place(
    redis_server: Process, store: RedisStore, foreign: tuple[str, ...]
) -> None:
    scene = scene_name()
    command, *words = foreign
    redis_server.command(command, SceneKeys(scene).log, *words)
    answers = await replay([store], scene, times(13))
    assert len(rows(answers)) == 2


@pytest.mark.parametrize("damaged", ["", "hello", "\0" * 40])
async def test_a_damaged_entry_is_left_out(
    redis_server: Process, store: RedisStore, other: RedisStore, damaged: str
) -> None:
    scene = scene_name()
    await replay([store], scene, times(12))
    redis_server.command("hset", SceneKeys(scene).log, "5", damaged)
    (answer,) = await replay([other], scene, times(13)[12:])
    assert (answer.scene_status, answer.track_statuses) == (
        SceneStatus.KEPT,
        [TrackStatus.KEPT, TrackStatus.KEPT],
    )
    held = unpack_instants((await other.read(scene, 99.0, "a")).instants.packed)
    assert len(held) == 12  # all but one


async def test_a_full_redis_says_so_and_recovers() -> None:
    with single("--maxmemory-policy", "noeviction") as server:
        async with opened(server.url) as store:
            scene = scene_name()
            answers = await replay([store], scene, times(6))
            server.command("config", "set", "maxmemory", "1")
            with pytest.raises(redis_errors.OutOfMemoryError):
                await replay([store], scene, times(7)[6:])
            server.command("config", "set", "maxmemory", "0")
            answers += await replay([store], scene, times(14)[6:])
            assert len(rows(answers)) == 4


async def test_an_entry_whose_answer_was_lost_counts_all_the_same(
    redis_server: Process, store: RedisStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_name()
    answers = await replay([store], scene, times(12))
    await lose_the_answer(store, scene, times(13)[12:], monkeypatch)
    answers += await replay([store], scene, times(14)[13:])
    assert rows(answers) == rows(await replay([memory()], scene, times(14)))


async def test_the_log_is_bounded_and_expires(redis_server: Process) -> None:
    scene = scene_name()
    log = SceneKeys(scene).log
    async with opened(redis_server.url, expiry=12.0) as store:
        await replay([store], scene, times(60))
        # A call a time: 22 of 10.5 s, and the one that is dropped with the next call
        entries = (number(redis_server, "hlen", log) - 3) / 2
        assert entries <= 23
        assert 11_000 < number(redis_server, "pttl", log) <= 12_000
        for agent in range(MAX_ENTRIES + 50):  # all at one time
            await store.exchange(scene, times(60)[-1], [track_update(times(60)[-1], f"{agent}", model="")])
        assert (number(redis_server, "hlen", log) - 3) / 2 == MAX_ENTRIES


async def test_the_log_is_bounded_where_a_recording_is_played_again(
    redis_server: Process, store: RedisStore
) -> None:
    scene = scene_name()
    log = SceneKeys(scene).log
    for _ in range(4):
        await replay([store], scene, times(60))
    await replay([store], scene, [times(60)[-1] + 100.0])  # a clock that is far ahead for once
    await replay([store], scene, times(60))
    assert (number(redis_server, "hlen", log) - 3) / 2 <= 23


async def test_a_server_that_sat_out_for_long_goes_on(store: RedisStore, other: RedisStore) -> None:
    scene = scene_name()
    await replay([store], scene, times(10))
    await replay([other], scene, times(60)[10:])  # by now what the first one knew is no longer needed
    (answer,) = await replay([store], scene, times(61)[60:])
    assert (answer.scene_status, answer.track_statuses) == (
        SceneStatus.KEPT,
        [TrackStatus.KEPT, TrackStatus.KEPT],
    )
    assert len(rows([answer])) == 2


async def test_reading_takes_nothing_from_the_next_call(
    redis_server: Process, store: RedisStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_name()
    answers = await replay([store], scene, times(12))
    await lose_the_answer(store, scene, times(13)[12:], monkeypatch)
    await store.read(scene, 99.0)
    answers += await replay([store], scene, times(14)[13:])
    assert rows(answers) == rows(await replay([memory()], scene, times(14)))

    redis_server.command("del", SceneKeys(scene).log)
    await store.read(scene, 99.0)
    (answer,) = await replay([store], scene, times(15)[14:])
    assert answer.scene_status is SceneStatus.LOST


async def test_something_else_in_the_events_place(redis_server: Process, store: RedisStore) -> None:
    scene = scene_name()
    redis_server.command("set", SceneKeys(scene).events, "hello")
    redis_server.command("set", SceneKeys(scene).published, "hello")
    await store.publish(scene, [b"1"])
    source = store.watch(scene)
    assert await anext(source) == ((), 0)
    await store.publish(scene, [b"2"])
    assert await anext(source) == ([b"2"], 0)
    await source.aclose()


@pytest.mark.parametrize(("step", "most"), [(0.5, 24_000), (0.1, 110_000)])
async def test_bytes_an_agent(redis_server: Process, store: RedisStore, step: float, most: int) -> None:
    scene, agents = scene_name(), 32
    for t in times(round(15 / step), step):
        await store.exchange(scene, t, [track_update(t, f"agent-{n}", off=9.0 * n) for n in range(agents)])
    size = number(redis_server, "memory", "usage", SceneKeys(scene).log, "samples", "0")
    assert size / agents < most


async def test_scenes_that_do_not_fit_are_read_again(redis_server: Process) -> None:
    async with opened(redis_server.url, max_agents=4) as store:
        scenes = [scene_name() for _ in range(5)]
        answers: dict[str, list[ExchangeResult]] = {scene: [] for scene in scenes}
        for t in times(14):
            for scene in scenes:
                answers[scene] += await replay([store], scene, [t])
            assert sum(len(each.memory) for each in store._scenes.values()) <= 4
        for scene in scenes:
            assert [answer.scene_status for answer in answers[scene]] == [SceneStatus.NEW] + [
                SceneStatus.KEPT
            ] * 13
            assert rows(answers[scene]) == rows(await replay([memory()], scene, times(14)))


async def test_a_cancelled_call_leaves_no_trouble(store: RedisStore) -> None:
    scene = scene_name()
    rng = random.Random(5)
    answers: list[ExchangeResult] = []
    for t in times(40):
        calls = [asyncio.create_task(store.exchange(scene, t, [track_update(t)])) for _ in range(3)]
        await asyncio.sleep(rng.uniform(0, 0.0015))
        calls[1].cancel()
        done = await asyncio.gather(*calls, return_exceptions=True)
        answers += [one for one in done if isinstance(one, ExchangeResult)]
        assert all(isinstance(one, ExchangeResult) for one in (done[0], done[2]))
    settled = rows(answers)
    assert len(settled) == len(set(settled)) == 28


class FakeWatchClient:
    """Client whose reads fail."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    async def xrevrange(self, *_: object, **__: object) -> list[object]:
        return []

    async def set(self, *_: object, **__: object) -> None:
        pass

    async def xread(self, *_: object, **__: object) -> None:
        raise self.error

    async def aclose(self) -> None:
        pass


async def next_of_a_watch(error: Exception) -> object:
    """Return the second item of a watch whose reads raise an error."""
    client = FakeWatchClient(error)
    source = RedisStore(client, client, 30.0, 100).watch("scene")
    assert await anext(source) == ((), 0)
    return await anext(source)


@pytest.mark.parametrize(
    "error",
    [
        redis_errors.ConnectionError("gone"),
        redis_errors.TimeoutError(),
        redis_errors.ResponseError("WRONGTYPE"),
        redis_errors.RedisClusterException(),
        ConnectionResetError(),
        TimeoutError(),
    ],
)
async def test_failures_of_redis_end_a_watch_as_such(error: Exception) -> None:
    with pytest.raises(StoreError) as raised:
        await next_of_a_watch(error)
    assert raised.value.__cause__ is error


@pytest.mark.parametrize(
    "error", [TypeError("bug"), AttributeError("bug"), KeyError("bug"), ValueError("bug")]
)
async def test_a_bug_in_a_watch_is_no_failure_of_redis(error: Exception) -> None:
    with pytest.raises(type(error)) as raised:
        await next_of_a_watch(error)
    assert raised.value is error


@pytest.mark.parametrize(("error", "told"), [(TypeError("bug"), TypeError), (ConnectionError(), None)])
async def test_the_renewal_of_a_watch_hides_no_bug(
    store: RedisStore, monkeypatch: pytest.MonkeyPatch, error: Exception, told: type[Exception] | None
) -> None:
    monkeypatch.setattr("service.tracking.store.redis.store._WATCHED_MS", 100)
    monkeypatch.setattr("service.tracking.store.redis.store._BLOCK_MS", 50)
    scene = scene_name()
    source = store.watch(scene)
    async with asyncio.timeout(20):
        await anext(source)

        async def fail(*_: object, **__: object) -> None:
            raise error

        monkeypatch.setattr(store._watch_client, "set", fail)
        await asyncio.sleep(0.1)
        if told is None:
            await store.publish(scene, [b"event"])
            assert await anext(source) == ([b"event"], 0)
        else:
            with pytest.raises(told):
                await anext(source)
    await source.aclose()
