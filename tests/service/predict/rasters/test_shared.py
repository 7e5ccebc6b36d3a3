"""Rasters in Redis: their budget, their expiry, and that their failures cost no call."""

import asyncio
import uuid
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager

import pytest
from prometheus_client import CollectorRegistry

from loadtest.redis_servers import Process, free_port, single
from service.errors import UnknownRaster
from service.predict.rasters.library import RasterLibrary
from service.predict.rasters.shared import SharedRasters
from service.redis_url import parse_address
from service.telemetry.metrics import Metrics
from service.tracking.collector import StoreMetrics
from service.tracking.store.redis.connection import connect
from tests.service.predict.rasters.test_library import BYTES, named, whole
from tests.service.servers import settings, until
from tests.service.tracking.store.stores import require_redis

BUDGET = 1000


@pytest.fixture(scope="module")
def redis() -> Iterator[Process]:
    require_redis()
    with single() as server:
        yield server


@pytest.fixture(autouse=True)
def _empty(redis: Process) -> None:
    redis.command("FLUSHALL")


@asynccontextmanager
async def shared(
    url: str, expiry: float = 10.0, max_bytes: int = BUDGET, timeout_s: float = 5.0
) -> AsyncIterator[SharedRasters]:
    client = connect(parse_address(url), timeout_s=timeout_s, connections=4)
    made = SharedRasters(client, expiry, max_bytes, StoreMetrics(CollectorRegistry()))
    try:
        yield made
    finally:
        await made.close()


async def put(rasters: SharedRasters, redis: Process, *sizes: int) -> list[bytes]:
    """Store one raster after the other, and return their digests."""
    digests = []
    for size in sizes:
        digests.append(uuid.uuid4().bytes * 2)
        rasters.put(digests[-1], bytes(size))
        await rasters.settle()
    return digests


def stored(redis: Process) -> int:
    """Return the bytes of all rasters in Redis, and check that they are accounted for."""
    fields = redis.command("HVALS", "cab:1:rasters:{rasters}:images")
    assert isinstance(fields, list)
    total = sum(map(len, fields))
    assert int(redis.text("GET", "cab:1:rasters:{rasters}:bytes")) == total
    assert redis.command("ZCARD", "cab:1:rasters:{rasters}:used") == len(fields)
    return total


async def test_stored_and_read(redis: Process) -> None:
    async with shared(redis.url) as rasters, shared(redis.url) as other:
        rasters.put(bytes(32), b"an image")
        await rasters.settle()
        assert await other.get(bytes(32), 1.0) == b"an image"
        assert await other.get(bytes(31) + b"1", 1.0) is None
        rasters.put(bytes(32), b"an image")  # a second time
        await rasters.settle()
        assert stored(redis) == len(b"an image")


async def test_the_least_recently_used_make_room(redis: Process) -> None:
    async with shared(redis.url) as rasters:
        a, b = await put(rasters, redis, 400, 400)
        await asyncio.sleep(0.005)  # uses are told apart by the millisecond
        assert await rasters.get(a, 1.0)
        await asyncio.sleep(0.005)
        (c,) = await put(rasters, redis, 400)
        assert stored(redis) == 800
        assert [bool(await rasters.get(digest, 1.0)) for digest in (a, b, c)] == [True, False, True]
        await put(rasters, redis, BUDGET + 1)  # more than all the room
        assert stored(redis) == 800
        await put(rasters, redis, BUDGET)
        assert stored(redis) == BUDGET


async def test_they_expire_unless_they_are_used(redis: Process) -> None:
    async with shared(redis.url, expiry=1.0) as rasters:
        a, b = await put(rasters, redis, 10, 10)
        for _ in range(5):
            await asyncio.sleep(0.25)
            rasters.touch(a)
            await rasters.settle()
        assert await rasters.get(a, 1.0)
        await put(rasters, redis, 10)  # drops what was not used
        assert await rasters.get(b, 1.0) is None
        for name in ("images", "used", "bytes"):
            left = redis.command("PTTL", f"cab:1:rasters:{{rasters}}:{name}")
            assert isinstance(left, int)
            assert 0 < left <= 1000


@pytest.mark.parametrize("lost", ["images", "used", "bytes"])
async def test_keys_that_redis_evicts_one_by_one(redis: Process, lost: str) -> None:
    async with shared(redis.url) as rasters:
        await put(rasters, redis, 300, 300)
        redis.command("DEL", f"cab:1:rasters:{{rasters}}:{lost}")
        (c,) = await put(rasters, redis, 500)
        assert await rasters.get(c, 1.0)
        assert stored(redis) == 500


@pytest.mark.parametrize("use", ["put", "touch", "get"])
async def test_rasters_are_given_up_before_redis_is_full(redis: Process, use: str) -> None:
    async with shared(redis.url, max_bytes=2**20) as rasters:
        a, _ = await put(rasters, redis, 300_000, 300_000)
        redis.command(
            "SET", "cab:1:{scene}:log", "x" * 20_000_000, "PX", 30_000
        )  # buffers of clients count little
        memory = redis.text("INFO", "memory")
        used = next(int(line[12:]) for line in memory.splitlines() if line.startswith("used_memory:"))
        redis.command("CONFIG", "SET", "maxmemory", round(1.5 * used))
        assert await rasters.get(a, 1.0)
        redis.command("CONFIG", "SET", "maxmemory", round(1.05 * used))
        try:
            if use == "get":
                assert await rasters.get(a, 1.0) is None
            elif use == "touch":
                rasters.touch(a)
            else:
                await put(rasters, redis, 100)
            await rasters.settle()
            assert redis.command("KEYS", "*") == [b"cab:1:{scene}:log"]
        finally:
            redis.command("CONFIG", "SET", "maxmemory", 0)


@asynccontextmanager
async def library(url: str, **values: float) -> AsyncIterator[RasterLibrary]:
    with ThreadPoolExecutor(2) as threads:
        made = settings(store=url, **values)
        rasters = RasterLibrary(
            made, Metrics(), threads, SharedRasters.from_settings(made, StoreMetrics(CollectorRegistry()))
        )
        try:
            yield rasters
        finally:
            await rasters.close()


async def test_what_one_server_got_the_other_has(redis: Process) -> None:
    sent = whole()
    async with library(redis.url) as one, library(redis.url) as other:
        mine = await one.find(sent, 10.0)
        await until(lambda: redis.command("EXISTS", "cab:1:rasters:{rasters}:images"))
        assert stored(redis) == sent.ByteSize() < BYTES  # as it was sent, not decoded
        theirs = await other.find(named(sent), 10.0)
        assert mine is not None
        assert theirs is not None
        assert (theirs.layers == mine.layers).all()
        redis.command("FLUSHALL")
        assert await other.find(named(sent), 10.0) is theirs


async def test_a_damaged_raster_is_unknown(redis: Process) -> None:
    sent, other = whole(0), whole(1)
    async with shared(redis.url, max_bytes=10**6) as rasters:
        rasters.put(sent.digest, other.SerializeToString())
        rasters.put(other.digest, b"\xff\xff")
        await rasters.settle()
    async with library(redis.url) as one:
        for message in (named(sent), named(other)):
            with pytest.raises(UnknownRaster):
                await one.find(message, 10.0)
        assert await one.find(sent, 10.0) is not None


@pytest.mark.parametrize("fault", ["away", "hanging", "full"])
async def test_a_failing_redis_costs_no_call(redis: Process, fault: str) -> None:
    sent = whole()
    url = f"redis://127.0.0.1:{free_port()}" if fault == "away" else redis.url
    if fault == "hanging":
        redis.pause()
    elif fault == "full":
        redis.command("CONFIG", "SET", "maxmemory-policy", "noeviction")
        redis.command("CONFIG", "SET", "maxmemory", 1)
    try:
        async with library(url, store_timeout_ms=300.0) as one:
            with pytest.raises(UnknownRaster):
                await one.find(named(sent), 10.0)
            first = await one.find(sent, 10.0)
            assert await one.find(named(sent), 10.0) is first
    finally:
        if fault == "hanging":
            redis.resume()
        redis.command("CONFIG", "SET", "maxmemory", 0)
