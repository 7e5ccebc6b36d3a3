"""Maps named by their digest, through live servers and the public client."""

import asyncio
import base64
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager

import httpx
import numpy as np
import pytest
from google.protobuf import json_format

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab_forecast import AsyncClient, raster_digest, scene_raster
from loadtest.redis_servers import Process, free_port, single
from service.server import Server
from tests.service.fakes import FakeForecaster
from tests.service.requests import make_request
from tests.service.servers import TRANSPORTS, CallError, running, until
from tests.service.tracking.store.stores import require_redis

PATIENT = {"store_timeout_ms": 5000.0}


def request(seed: int = 0) -> pb.PredictRequest:
    """Return a request whose raster is the seed's."""
    layers = np.random.default_rng(seed).integers(0, 2, (3, 150, 150))
    made = make_request(2)
    made.scene_raster.CopyFrom(scene_raster(layers, (-50.0, -50.0)))
    return made


def with_digest(whole: pb.PredictRequest, alone: bool = False) -> pb.PredictRequest:
    """Return a request with the digest of its raster."""
    made = pb.PredictRequest()
    made.CopyFrom(whole)
    if alone:
        made.ClearField("scene_raster")
    made.scene_raster.digest = raster_digest(whole.scene_raster)
    return made


def lookups(server: Server) -> dict[str, float]:
    """Return the number of rasters by source; sources without any are left out."""
    counts = {
        source: server.metrics.registry.get_sample_value("forecast_raster_lookups_total", {"source": source})
        for source in ("sent", "memory", "redis", "unknown")
    }
    return {source: count for source, count in counts.items() if count}


@pytest.fixture(scope="module")
def redis() -> Iterator[Process]:
    require_redis()
    with single() as server:
        yield server


@asynccontextmanager
async def clients(*servers: Server, transport: str) -> AsyncIterator[list[AsyncClient]]:
    addresses = [each.grpc_address if transport == "grpc" else each.http_address for each in servers]
    made = [AsyncClient(f"{transport}://{address}", timeout=30.0) for address in addresses]
    try:
        yield made
    finally:
        await asyncio.gather(*(each.close() for each in made))


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_answers_are_those_of_the_whole_raster(transport: str) -> None:
    call, fake, whole = TRANSPORTS[transport], FakeForecaster(uses_map=True), request()
    async with running(fake) as server:
        with pytest.raises(CallError) as caught:
            await call(server, with_digest(whole, alone=True))
        assert (caught.value.code, caught.value.reason) == ("FAILED_PRECONDITION", "UNKNOWN_RASTER")
        plain = await call(server, whole)
        with pytest.raises(CallError):  # without a digest it was not kept
            await call(server, with_digest(whole, alone=True))
        sent = await call(server, with_digest(whole))
        named = await call(server, with_digest(whole, alone=True))
        assert lookups(server) == {"unknown": 2, "sent": 1, "memory": 1}
    for answer in (sent, named):
        assert answer.forecasts == plain.forecasts
        assert not answer.warnings
    rasters = [scene.raster for scene in fake.scenes]
    assert all(raster is not None for raster in rasters)
    assert rasters[-1] is rasters[-2]


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_a_wrong_digest_is_a_bad_field(transport: str) -> None:
    wrong = with_digest(request())
    wrong.scene_raster.origin_x += 1
    async with running() as server:
        with pytest.raises(CallError) as caught:
            await TRANSPORTS[transport](server, wrong)
        (fault,) = caught.value.faults
        assert fault[0] == "scene_raster.digest"
        assert raster_digest(wrong.scene_raster).hex() in fault[1]


async def test_json() -> None:
    whole = request()
    async with running() as server, httpx.AsyncClient(timeout=20) as client:
        url = f"http://{server.http_address}/v1/predict"
        document = json_format.MessageToDict(whole, preserving_proto_field_name=True)
        digest = base64.b64encode(raster_digest(whole.scene_raster)).decode()
        named = document | {"scene_raster": {"digest": digest}}
        missing = await client.post(url, json=named)
        assert (missing.status_code, missing.json()["reason"]) == (412, "UNKNOWN_RASTER")
        document["scene_raster"]["digest"] = digest
        sent = await client.post(url, json=document)
        again = await client.post(url, json=named)
        assert (sent.status_code, again.status_code) == (200, 200)
        assert sent.json()["forecasts"] == again.json()["forecasts"]


@pytest.mark.parametrize("transport", ["grpc", "http"])
async def test_replicas_share_what_one_of_them_got(redis: Process, transport: str) -> None:
    redis.command("FLUSHALL")
    whole = request()
    async with (
        running(store=redis.url, **PATIENT) as one,
        running(store=redis.url, **PATIENT) as other,
        clients(one, other, transport=transport) as (first, _),
    ):
        expected = await first.predict(whole)
        await until(lambda: redis.command("EXISTS", "cab:1:rasters:{rasters}:images"))
        answer = await TRANSPORTS["grpc"](other, with_digest(whole, alone=True))
        assert list(answer.forecasts) == list(expected.forecasts)
        assert (lookups(one), lookups(other)) == ({"sent": 1}, {"redis": 1})


async def test_a_restarted_server_gets_the_raster_again() -> None:
    address = f"127.0.0.1:{free_port()}"
    seen = []
    async with AsyncClient(f"http://{address}", timeout=30.0) as client:
        for _ in range(2):
            async with running(http=address) as server:
                for _ in range(2):
                    assert len((await client.predict(request())).forecasts) == 2
                seen.append(lookups(server))
    assert seen == [{"sent": 1, "memory": 1}, {"unknown": 1, "sent": 1, "memory": 1}]


async def test_clients_that_begin_at_once() -> None:
    fake = FakeForecaster(uses_map=True)
    async with running(fake) as server, clients(*[server] * 4, transport="grpc") as many:
        answers = await asyncio.gather(*(client.predict(request()) for client in many))
        assert all(answer.forecasts == answers[0].forecasts for answer in answers)
        assert lookups(server) == {"sent": 4}
    assert len({id(scene.raster) for scene in fake.scenes}) == 1


async def test_a_redis_that_dies_fails_no_call() -> None:
    require_redis()
    with single() as dying:
        async with running(store=dying.url) as server, clients(server, transport="grpc") as (client,):
            await client.predict(request())
            dying.kill()
            for seed in (0, 1, 1, 2):
                assert len((await client.predict(request(seed))).forecasts) == 2
            assert lookups(server) == {"sent": 3, "memory": 2}
