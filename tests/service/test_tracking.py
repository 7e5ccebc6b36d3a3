"""Track memory through a live server, against the offline metrics of the same forecasts."""

import subprocess
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from structlog.testing import capture_logs

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from cab_forecast import AsyncClient, BadRequest, ForecastError, Overloaded, TrackingUnavailable, UnknownTrack
from loadtest.redis_servers import free_port, single
from service.server import Server
from tests.nuscenes_pred import real_tracks
from tests.service.fakes import FakeForecaster
from tests.service.processes import process, ready
from tests.service.servers import running
from tests.service.tracking.store.stores import require_redis, scene_name
from tests.service.tracks import (
    Replayed,
    Track,
    Tracks,
    Watch,
    at_rate,
    check,
    late,
    live,
    made_up,
    offline,
    replay,
)

MODEL = "kalman"
PATIENT = {"store_budget_ms": 5000.0, "store_timeout_ms": 5000.0}
"""Settings with budgets that a busy machine does not exceed."""


@pytest.fixture(scope="module")
def redis_url() -> Iterator[str]:
    require_redis()
    with single() as server:
        yield server.url


@pytest.fixture(params=["memory", "redis"])
async def server(request: pytest.FixtureRequest) -> AsyncIterator[Server]:
    store = "memory" if request.param == "memory" else request.getfixturevalue("redis_url")
    async with running(store=store, default_model=MODEL, **PATIENT) as started:
        yield started


@pytest.fixture(params=["grpc", "http"])
async def client(request: pytest.FixtureRequest, server: Server) -> AsyncIterator[AsyncClient]:
    address = server.grpc_address if request.param == "grpc" else server.http_address
    async with AsyncClient(f"{request.param}://{address}", timeout=30.0) as made:
        yield made


@pytest.mark.parametrize("step", [0.5, 0.1])
@pytest.mark.parametrize("lateness", [0.0, 1.9])
async def test_live_is_as_offline(client: AsyncClient, step: float, lateness: float) -> None:
    tracks = made_up(scene_name(), step)
    replayed = Replayed()
    async with Watch(client, tracks, replayed) as watch:
        await replay([client], tracks, MODEL, late(tracks.frames(), step, lateness), into=replayed)
        instants = await check(tracks, replayed, watch)
    # Each agent is there a second less than the one before; its first 6 s and first frame make no set
    assert instants == sum(round((12 - number - 6) / step) - 1 for number in range(4))
    (model,) = await client.model_consistency()
    assert (model.model.name, model.instants) == (MODEL, instants)


@pytest.mark.parametrize("step", [0.5, 0.1])
async def test_live_is_as_offline_on_real_tracks(shared: Path, server: Server, step: float) -> None:
    """500 vehicles of nuScenes, late and out of order; of each scene 6.5 s, from the scenes with most on."""
    labels = sorted(
        (shared / "data/nuscenes_pred/label").glob("*/*.txt"), key=lambda file: -file.stat().st_size
    )
    agents = 0
    async with AsyncClient(f"grpc://{server.grpc_address}", timeout=30.0) as client:
        for file in labels:
            tracks = real_scene(file, step)
            replayed = Replayed()
            async with Watch(client, tracks, replayed) as watch:
                await replay([client], tracks, MODEL, late(tracks.frames(), step, 1.9), into=replayed)
                await check(tracks, replayed, watch)
            agents += len({agent_id for agent_id, _ in replayed.settled})
            if agents >= 500:
                return
    pytest.fail(f"only {agents} agents")


def real_scene(labels: Path, step: float) -> Tracks:
    """Return the 14 consecutive frames of a scene with the most vehicles present in all of them."""
    rows = real_tracks(labels)
    frames = 14

    def there(first: int) -> list[str]:
        wanted = set(range(first, first + frames))
        return [name for name, row in rows.items() if wanted <= row.keys()]

    first = max({frame for row in rows.values() for frame in row}, key=lambda frame: len(there(frame)))
    agents = {}
    for name in there(first):
        position = np.array([rows[name][frame][:2] for frame in range(first, first + frames)])
        agents[name] = at_rate(Track(first, position), round(0.5 / step))
    return Tracks(scene_name(), 1.7e9, step, agents, history_s=step)


@pytest.mark.parametrize("step", [0.5, 0.1])
async def test_histories_from_memory_are_as_good_as_in_the_request(server: Server, step: float) -> None:
    tracks = replace(made_up(scene_name(), step, seconds=6.0), history_s=6.0)
    frames = tracks.frames()
    async with AsyncClient(server.grpc_address, timeout=30.0) as client:
        whole = await replay([client], tracks, MODEL, frames)
        remembered = made_up(scene_name(), step, seconds=6.0)
        twice = [frame for frame in frames for _ in range(2)]
        newest = await replay([client], remembered, MODEL, twice, newest_only=True)
    assert whole.paths.keys() == newest.paths.keys()
    for frame in frames:
        expected, answer = whole.answers[frame], newest.answers[frame]
        assert [one.status for one in answer.forecasts] == [one.status for one in expected.forecasts]
        for ours, theirs in zip(answer.forecasts, expected.forecasts, strict=True):
            assert ours.history_frames == theirs.history_frames
            np.testing.assert_allclose(ours.means, theirs.means, rtol=0, atol=1e-9)
            np.testing.assert_allclose(ours.weights, theirs.weights, rtol=0, atol=1e-9)
    assert {one.status for one in newest.answers[frames[-1]].forecasts} == {pb.FORECAST_STATUS_OK}


async def test_a_late_call_sees_nothing_of_what_came_after_it(server: Server) -> None:
    tracks = made_up(scene_name(), agents=1)
    async with AsyncClient(server.grpc_address, timeout=30.0) as client:
        in_order = await replay([client], tracks, MODEL, range(8), newest_only=True)
        again = made_up(scene_name(), agents=1)
        out_of_order = await replay([client], again, MODEL, [0, 1, 2, 3, 4, 6, 7, 5], newest_only=True)
    np.testing.assert_array_equal(out_of_order.paths["agent 0", 5], in_order.paths["agent 0", 5])


async def test_statuses_of_agents_and_scene(server: Server) -> None:
    tracks = made_up(scene_name(), agents=2)
    async with AsyncClient(server.grpc_address, timeout=30.0) as client:

        async def ask(request: pb.PredictRequest) -> tuple[int, list[int]]:
            answer = await client.predict(request)
            return answer.tracking, [one.tracking for one in answer.forecasts]

        ok, new = consistency_pb.TRACKING_STATUS_OK, consistency_pb.TRACKING_STATUS_NEW
        reset = consistency_pb.TRACKING_STATUS_RESET
        assert await ask(tracks.request(1, MODEL)) == (new, [new])
        assert await ask(tracks.request(2, MODEL)) == (ok, [ok, new])
        moved = tracks.request(3, MODEL)
        for state in moved.agents[0].states:
            state.x += 100.0
        assert await ask(moved) == (ok, [reset, ok])
        untracked = tracks.request(4, MODEL)
        untracked.scene_id = ""
        assert await ask(untracked) == (0, [0, 0])
        assert await client.reset_scene(tracks.name) == 2
        assert await ask(tracks.request(4, MODEL)) == (new, [new, new])


async def test_the_answer_tells_the_latest_consistency(server: Server) -> None:
    tracks = made_up(scene_name(), agents=2)
    async with AsyncClient(server.grpc_address, timeout=30.0) as client:
        replayed = await replay([client], tracks, MODEL, range(1, 20))
        request = tracks.request(20, MODEL)
        request.options.consistency = True
        answer = await client.predict(request)
        first, second = answer.forecasts
        assert first.consistency.settled
        assert first.consistency.time == tracks.time(20)
        assert first.consistency.model == first.model
        replayed.paths |= {(f.agent_id, 20): np.array(f.means).reshape(-1, 2)[:12] for f in answer.forecasts}
        expected = offline(tracks, replayed.paths)
        np.testing.assert_allclose(live(first.consistency), expected["agent 0", 20], rtol=0, atol=1e-6)
        for frame in (21, 22):
            await client.predict(tracks.request(frame, MODEL))
        held = await client.agent_consistency(tracks.name, "agent 1", window=3.0)
        assert [one.time for one in held] == [tracks.time(frame) for frame in range(16, 23)]
        scene = await client.scene_consistency(tracks.name)
        assert [(one.agent_id, one.time) for one in scene.latest] == [
            ("agent 0", tracks.time(22)),
            ("agent 1", tracks.time(22)),
        ]
        assert second.consistency.agent_id == "agent 1"


@pytest.mark.parametrize("field", ["history", "consistency"])
async def test_what_needs_a_scene(server: Server, field: str) -> None:
    request = made_up("", agents=1).request(3, MODEL)
    setattr(request.options, field, 2 if field == "history" else True)
    async with AsyncClient(server.grpc_address) as client:
        with pytest.raises(BadRequest, match=rf"options\.{field}: needs a scene_id"):
            await client.predict(request)


async def test_blind_forecasts_are_not_remembered() -> None:
    tracks = made_up(scene_name(), agents=1)
    async with (
        running(FakeForecaster(supports_blind=True), **PATIENT) as server,
        AsyncClient(server.grpc_address, timeout=30.0) as client,
    ):
        for frame in range(1, 15):
            request = tracks.request(frame, "fake")
            request.options.context = pb.CONTEXT_BLIND
            await client.predict(request)
        assert await client.agent_consistency(tracks.name, "agent 0") == []
        assert await client.model_consistency() == []


@dataclass(frozen=True)
class Served:
    """Server in a process of its own."""

    process: "subprocess.Popen[str]"
    client: AsyncClient


@asynccontextmanager
async def served(store: str) -> AsyncIterator[Served]:
    """Run a server with the bundled models."""
    with process("--log-json", "--store", store, "--default-model", MODEL, **PATIENT) as started:
        _, address = ready(started)
        async with AsyncClient(address, timeout=30.0) as client:
            yield Served(started, client)


async def test_two_servers_on_one_redis_one_of_them_killed(redis_url: str) -> None:
    """Two servers take the calls of each scene in turn; one is killed and replaced midway."""
    scenes = [made_up(scene_name()) for _ in range(3)]
    async with AsyncExitStack() as stack:
        staying = await stack.enter_async_context(served(redis_url))
        killed = await stack.enter_async_context(served(redis_url))
        replayed = [Replayed() for _ in scenes]
        watches = [
            await stack.enter_async_context(Watch(staying.client, tracks, one))
            for tracks, one in zip(scenes, replayed, strict=True)
        ]
        frames = scenes[0].frames()
        half = len(frames) // 2
        for tracks, one in zip(scenes, replayed, strict=True):
            await replay([staying.client, killed.client], tracks, MODEL, frames[:half], into=one)
        killed.process.kill()
        replacement = await stack.enter_async_context(served(redis_url))
        for tracks, one in zip(scenes, replayed, strict=True):
            await replay([replacement.client, staying.client], tracks, MODEL, frames[half:], into=one)
        for tracks, one, watch in zip(scenes, replayed, watches, strict=True):
            assert await check(tracks, one, watch) == sum(2 * (12 - number - 6) - 1 for number in range(4))
            statuses = {answer.tracking for answer in one.answers.values()}
            assert statuses == {
                consistency_pb.TRACKING_STATUS_NEW,
                consistency_pb.TRACKING_STATUS_OK,
            }


async def test_forecasts_go_on_without_the_memory() -> None:
    """Redis is unreachable: each response says so, and consistency calls give the reason."""
    tracks = made_up(scene_name(), agents=2)
    away = f"redis://127.0.0.1:{free_port()}"
    async with (
        running(store=away, default_model=MODEL) as server,
        AsyncClient(server.grpc_address, timeout=30.0, retries=0) as client,
    ):
        replayed = await replay([client], tracks, MODEL, range(1, 8))
        newest = await replay([client], tracks, MODEL, range(8, 10), newest_only=True)
        for answer in (*replayed.answers.values(), *newest.answers.values()):
            assert answer.tracking == consistency_pb.TRACKING_STATUS_UNAVAILABLE
            assert {one.tracking for one in answer.forecasts} == {answer.tracking}
        assert len(replayed.paths) == 7 + 5  # the second agent comes a second later
        with pytest.raises(TrackingUnavailable, match="the track memory"):
            await client.scene_consistency(tracks.name)
        with pytest.raises(TrackingUnavailable):
            await client.reset_scene(tracks.name)
        with pytest.raises(TrackingUnavailable):
            await anext(client.watch_scene(tracks.name))
        assert await client.model_consistency() == []
        metrics = server.metrics.render().decode()
        errors = [line for line in metrics.splitlines() if "track_store_errors_total{" in line]
        assert any('op="exchange",reason="refused"' in line for line in errors)


async def test_no_more_than_so_many_watch(server: Server) -> None:
    async with AsyncClient(server.grpc_address, timeout=30.0, retries=0) as client, AsyncExitStack() as stack:
        for _ in range(server.settings.max_watchers):
            await stack.enter_async_context(client.watch_scene(scene_name()))
        with pytest.raises(Overloaded, match="64 calls watch already"):
            async with client.watch_scene(scene_name()):
                pass


async def test_a_bug_while_watching_is_internal_and_in_the_log(
    redis_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(*_: object, **__: object) -> None:
        raise TypeError("a secret")

    async with running(store=redis_url, default_model=MODEL, **PATIENT) as server:
        for address in (f"grpc://{server.grpc_address}", f"http://{server.http_address}"):
            async with AsyncClient(address, timeout=30.0, retries=0) as client:
                with capture_logs() as logs, monkeypatch.context() as patch:
                    patch.setattr("redis.asyncio.Redis.xread", fail)
                    with pytest.raises(ForecastError) as raised:
                        async with client.watch_scene(scene_name()) as events:
                            await anext(events)
                assert raised.value.code == "INTERNAL"
                assert "secret" not in str(raised.value)
                (logged,) = [one for one in logs if one["log_level"] == "error"]
                assert isinstance(logged["exc_info"], TypeError)
        lines = server.metrics.render().decode().splitlines()
        errors = [line for line in lines if "store_errors_total{" in line and not line.endswith(" 0.0")]
        assert errors == []


async def test_an_agent_that_nothing_was_forecast_for(server: Server) -> None:
    tracks = made_up(scene_name(), agents=1)
    request = tracks.request(3, MODEL)
    request.agents[0].predict = False
    async with AsyncClient(server.grpc_address, timeout=30.0) as client:
        await client.predict(request)
        assert await client.agent_consistency(tracks.name, "agent 0") == []
        with pytest.raises(UnknownTrack):
            await client.agent_consistency(tracks.name, "agent 1")
