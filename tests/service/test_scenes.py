"""Live scenes through running servers: what watchers get, and that forecasts do not wait for them."""

import asyncio
import socket
from collections.abc import AsyncIterator, Iterator
from itertools import count
from urllib.parse import quote

import httpx
import numpy as np
import orjson
import pytest
import pytest_asyncio

from cab.forecast.v1 import prediction_service_pb2 as predict_pb
from cab.forecast.v1 import scene_service_pb2 as pb
from cab.forecast.v1.digest import raster_digest
from cab_forecast import AsyncClient, BadRequest, Overloaded
from cab_forecast.demo import demo_request
from loadtest.redis_servers import single
from service.server import Server
from service.transports.rest.codec import to_dict
from tests.service.fakes import FakeForecaster
from tests.service.requests import NOW, PEDESTRIAN, add_agent, make_request
from tests.service.servers import running, until
from tests.service.tracking.store.stores import require_redis, scene_name

pytestmark = pytest.mark.asyncio(loop_scope="module")


@pytest.fixture(scope="module")
def redis_url() -> Iterator[str]:
    require_redis()
    with single() as server:
        yield server.url


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def server() -> AsyncIterator[Server]:
    """One server for the tests that do not change it: each has a scene of its own."""
    async with running(FakeForecaster(modes=4)) as made:
        yield made


@pytest_asyncio.fixture(params=["grpc", "http"], loop_scope="module")
async def client(request: pytest.FixtureRequest, server: Server) -> AsyncIterator[AsyncClient]:
    async with client_of(server, request.param) as made:
        yield made


def client_of(server: Server, transport: str = "grpc") -> AsyncClient:
    address = server.grpc_address if transport == "grpc" else server.http_address
    return AsyncClient(f"{transport}://{address}", timeout=30.0, retries=0)


def value(server: Server, name: str, **labels: str) -> float:
    return server.metrics.registry.get_sample_value(name, labels) or 0.0


Events = AsyncIterator[pb.WatchForecastsResponse]


async def event_of(events: Events, kind: str) -> pb.WatchForecastsResponse:
    """Return the next event of a kind."""
    async with asyncio.timeout(20):
        async for event in events:
            if event.HasField(kind):  # type: ignore[arg-type]
                return event
    raise AssertionError(f"no {kind}")


async def frame(events: Events) -> pb.ForecastFrame:
    """Return the next frame."""
    return (await event_of(events, "frame")).frame


def request_of(scene_id: str, agents: int = 3, time: float = NOW) -> predict_pb.PredictRequest:
    request = make_request(agents)
    request.scene_id = scene_id
    for agent in request.agents:
        for state in agent.states:
            state.time += time - request.time
    request.time = time
    return request


async def test_a_frame_shows_what_the_response_says(client: AsyncClient) -> None:
    name = scene_name()
    request = demo_request()
    request.scene_id = name
    request.options.merge = True
    request.options.consistency = True
    request.agents[1].predict = False
    request.agents.add(id="broken", type=1).states.add(time=request.time, x=1e9, y=2.0)
    async with client.watch_forecasts(name) as events:
        response = await client.predict(request)
        shown = (await event_of(events, "map")).map
        seen = await frame(events)
        listed = await client.list_scenes()
    assert shown.digest == seen.map_digest == raster_digest(request.scene_raster)
    sent_map = request.scene_raster
    assert (shown.origin_x, shown.pixels_per_meter) == (sent_map.origin_x, sent_map.pixels_per_meter)
    assert (seen.scene_id, seen.time, seen.model) == (name, request.time, response.model)
    assert (seen.steps, seen.step, seen.shadow) == (response.steps, response.step, False)
    assert seen.inference_seconds == response.timing.inference > 0
    assert [agent.id for agent in seen.agents] == [agent.id for agent in request.agents]
    by_id = {forecast.agent_id: forecast for forecast in response.forecasts}
    for agent, sent in zip(seen.agents, request.agents, strict=True):
        forecast = by_id.get(agent.id)
        assert agent.type == sent.type
        assert agent.predicted is (sent.predict if sent.HasField("predict") else True)
        if forecast is None:
            assert (agent.status, list(agent.weights)) == (0, [])
            continue
        assert (agent.status, agent.detail) == (forecast.status, forecast.detail)
        assert list(agent.warnings) == list(forecast.warnings)
        order = np.argsort(-np.array(forecast.weights), kind="stable")[:5]
        np.testing.assert_allclose(agent.weights, np.array(forecast.weights)[order], atol=1e-4)
        for field, size, atol in (("means", 2, 0.0051), ("covariances", 3, 2e-4)):
            full = np.array(getattr(forecast, field)).reshape(-1, response.steps, size)[order]
            np.testing.assert_allclose(getattr(agent, field), full.reshape(-1), atol=atol)
    broken = seen.agents[-1]
    assert broken.status == predict_pb.FORECAST_STATUS_INVALID
    assert [(state.x, state.y) for state in broken.states] == [(1e9, 2.0)]
    assert [(one.scene_id, one.agents) for one in listed if one.scene_id == name] == [(name, len(by_id) - 1)]


async def test_a_frames_states_and_map_make_the_same_forecast_again(client: AsyncClient) -> None:
    request = demo_request()
    request.scene_id = scene_name()
    request.model = "kalman"
    async with client.watch_forecasts(request.scene_id) as events:
        first = await client.predict(request)
        seen = await frame(events)
    again = predict_pb.PredictRequest(time=seen.time, model="kalman")
    again.scene_raster.digest = seen.map_digest
    for agent in seen.agents:
        again.agents.add(id=agent.id, type=agent.type, states=agent.states, predict=agent.predicted)
    assert not request.scene_raster.digest  # its map is kept because its scene is watched
    second = await client.predict(again)
    for one, other in zip(first.forecasts, second.forecasts, strict=True):
        assert one.status == other.status
        np.testing.assert_allclose(one.means, other.means, atol=0.05)


async def test_json_is_the_contracts_mapping(server: Server) -> None:
    """The JSON of a frame is not written from its message, so they are compared."""
    name = scene_name()
    async with client_of(server) as client, httpx.AsyncClient(timeout=20) as http:
        address = f"http://{server.http_address}/v1/scenes/{name}/forecasts/watch"
        async with http.stream("GET", address) as response, client.watch_forecasts(name) as events:
            lines = response.aiter_lines()
            request = request_of(name)
            request.agents[0].states[-1].ClearField("heading")
            add_agent(request, "walker", kind=PEDESTRIAN)
            request.options.consistency = True
            for step in range(3):
                later = request_of(name, time=NOW + 0.5 * step)
                later.agents.add().CopyFrom(request.agents[-1])
                await client.predict(later)
                seen = await frame(events)
                while b"frame" not in (line := (await anext(lines)).encode()):
                    pass
                document = orjson.loads(line.removeprefix(b"data: "))["frame"]
                assert document == orjson.loads(orjson.dumps(to_dict(seen)))
    assert seen.agents[0].HasField("consistency")
    assert seen.agents[0].consistency.errors[0].age == 0.5


async def test_nothing_is_made_while_nobody_watches(client: AsyncClient, server: Server) -> None:
    name = scene_name()
    await until(lambda: value(server, "forecast_watchers", method="WatchForecasts") == 0)
    before = value(server, "forecast_frames_total")
    async with client.watch_forecasts(scene_name()):
        await client.predict(request_of(name))
        assert (await client.list_scenes())[0].scene_id == name
        assert value(server, "forecast_watchers", method="WatchForecasts") == 1
    await until(lambda: value(server, "forecast_watchers", method="WatchForecasts") == 0)
    await client.predict(request_of(name, time=NOW + 0.5))
    assert value(server, "forecast_frames_total") == before


async def test_shadows_are_shown_beside() -> None:
    models = FakeForecaster(modes=4), FakeForecaster(version="2.0.0", modes=6)
    chosen = {"default_model": "fake@1.0.0", "shadow": "fake@2.0.0:1", "max_batch_agents": 8}
    async with running(*models, **chosen) as server, client_of(server, "http") as client:
        name = scene_name()
        async with client.watch_forecasts(name) as events:
            await client.predict(request_of(name))
            first, second = await frame(events), await frame(events)
    assert [(one.shadow, one.model.version) for one in (first, second)] == [(False, "1.0.0"), (True, "2.0.0")]
    assert first.time == second.time
    assert second.scene_id == name
    assert all(agent.means for agent in second.agents)


@pytest.mark.parametrize("name", ["a/b c", "ä%2F&?", ".", ".."])
async def test_any_id_can_be_watched(server: Server, name: str) -> None:
    async with client_of(server, "http") as client, client.watch_forecasts(name) as events:
        await client.predict(request_of(name))
        assert (await frame(events)).scene_id == name


@pytest.mark.parametrize("name", ["", "s" * 129])
async def test_bad_ids_are_named(client: AsyncClient, name: str) -> None:
    with pytest.raises(BadRequest, match="scene_id"):
        async with client.watch_forecasts(name):
            pass


async def test_watchers_of_both_kinds_have_one_bound() -> None:
    async with (
        running(FakeForecaster(), max_watchers=2) as server,
        client_of(server) as client,
        client.watch_scene("s"),
        client.watch_forecasts("s"),
    ):
        with pytest.raises(Overloaded, match="2 calls watch already"):
            async with client.watch_forecasts("s"):
                pass
    assert value(server, "forecast_refused_total", reason="watchers") == 1


async def test_streams_end_when_the_server_drains() -> None:
    async with (
        running(FakeForecaster()) as server,
        client_of(server) as grpc,
        client_of(server, "http") as http,
        grpc.watch_forecasts("s") as events,
        http.watch_forecasts("s") as others,
    ):
        await server.stop()
        for ended in (events, others):
            with pytest.raises(StopAsyncIteration):
                await anext(ended)


async def test_a_watcher_that_does_not_read_delays_no_forecast(server: Server) -> None:
    name = scene_name()
    host, port = server.http_address.split(":")
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.connect((host, int(port)))
    _, writer = await asyncio.open_connection(sock=connection, limit=1024)
    writer.write(f"GET /v1/scenes/{quote(name)}/forecasts/watch HTTP/1.1\r\nHost: x\r\n\r\n".encode())
    await until(lambda: value(server, "forecast_watchers", method="WatchForecasts") == 1)
    dropped = 0.0
    async with client_of(server) as client, client.watch_forecasts(name) as events:
        for step in range(24):
            async with asyncio.timeout(5):
                await client.predict(request_of(name, agents=200, time=NOW + 0.1 * step))
                assert (await frame(events)).time == NOW + 0.1 * step
            dropped = value(server, "forecast_frames_dropped_total", reason="watcher")
            if dropped:
                break
    assert dropped
    writer.transport.abort()
    await until(lambda: value(server, "forecast_watchers", method="WatchForecasts") == 0)


async def test_replicas_share_scenes_and_frames(redis_url: str) -> None:
    patient = {"store": redis_url, "store_budget_ms": 5000.0, "store_timeout_ms": 5000.0}
    name = scene_name()
    async with (
        running(FakeForecaster(), **patient) as made,
        running(FakeForecaster(), **patient) as watched,
        client_of(made) as caller,
        client_of(watched, "http") as watcher,
        watcher.watch_forecasts(name) as events,
    ):
        feeding = asyncio.create_task(feed(caller, name))
        try:
            async with asyncio.timeout(20):
                shown = (await event_of(events, "map")).map
                seen = [await frame(events) for _ in range(3)]
            listed = [one for one in await watcher.list_scenes() if one.scene_id == name]
        finally:
            feeding.cancel()
            await asyncio.gather(feeding, return_exceptions=True)
        assert shown.digest == seen[0].map_digest
        demo = demo_request()
        assert shown.width == demo.scene_raster.columns
        times = [one.time for one in seen]
        assert times == sorted(times)
        assert seen[0].agents[0].means
        assert [one.agents for one in listed] == [len(demo.agents)]
        assert value(watched, "forecast_frames_total") == 0
        assert value(made, "forecast_frames_total") >= 3


async def feed(client: AsyncClient, scene_id: str) -> None:
    """Send the demo again and again, each time a little later."""
    for step in count():
        request = demo_request(NOW + 0.1 * step)
        request.scene_id = scene_id
        await client.predict(request)
        await asyncio.sleep(0.05)


async def test_without_redis_the_own_scenes_are_still_shown() -> None:
    nobody = {"store": "redis://127.0.0.1:1", "store_budget_ms": 50.0}
    async with running(FakeForecaster(), **nobody) as server, client_of(server) as client:
        name = scene_name()
        async with client.watch_forecasts(name) as events:
            await client.predict(request_of(name))
            assert (await frame(events)).scene_id == name
        assert [one.scene_id for one in await client.list_scenes()] == [name]
