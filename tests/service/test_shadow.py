"""The shadow model: its metrics beside the first model's, and nothing of it in responses."""

import asyncio
from collections import Counter
from collections.abc import Sequence
from itertools import count

import numpy as np
import pytest
from structlog.testing import capture_logs

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab_forecast import AsyncClient, scene_raster
from model.registry import Registry
from service.predict.catalog import Models
from service.predict.plan import Plan
from service.predict.publisher import Publisher
from service.server import Server
from tests.service.fakes import FakeForecaster, registry
from tests.service.requests import NOW, add_agent, make_request
from tests.service.servers import TRANSPORTS, call_grpc, running, settings, until

RESULTS = ("done", "dropped", "failed")
NAME = "fake@2.0.0"
"""The shadow: another version of the default model."""


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let calls wait for longer than a busy machine makes them."""
    monkeypatch.setattr("service.predict.shadow._MAX_AGE", 60.0)


def pair() -> tuple[FakeForecaster, FakeForecaster]:
    """Return the default model, pinned to the first version by the settings, and the shadow."""
    return FakeForecaster(modes=4), FakeForecaster(version="2.0.0", modes=6)


def shadowed(share: str = "1") -> dict[str, object]:
    return {"default_model": "fake@1.0.0", "shadow": f"{NAME}:{share}", "max_batch_agents": 8}


def value(server: Server, name: str, **labels: str) -> float:
    return server.metrics.registry.get_sample_value(name, labels) or 0.0


def calls(server: Server) -> dict[str, int]:
    """Return the calls of the shadow by result."""
    name = "forecast_shadow_calls_total"
    return {result: int(value(server, name, model=NAME, result=result)) for result in RESULTS}


@pytest.mark.parametrize("transport", ["grpc", "http"])
async def test_its_series_stand_beside_the_firsts_and_responses_hold_nothing_of_it(transport: str) -> None:
    old, new = pair()
    frames = 15
    async with running(old, new, **shadowed()) as server:
        address = server.grpc_address if transport == "grpc" else f"http://{server.http_address}"
        async with AsyncClient(address, timeout=20) as client:
            for frame in range(frames):
                request = pb.PredictRequest(scene_id="street", time=NOW + 0.5 * frame)
                request.options.consistency = True
                add_agent(request, x=2.5 * frame)
                response = await client.predict(request)
                assert response.model.version == "1.0.0"
                for forecast in response.forecasts:
                    assert (forecast.model.version, len(forecast.weights)) == ("1.0.0", 4)
                    assert forecast.consistency.model.version in {"", "1.0.0"}
                await until(lambda frame=frame: calls(server)["done"] == frame + 1)  # type: ignore[misc]
            scene = await client.scene_consistency("street")
            assert {instant.model.version for instant in scene.latest} == {"1.0.0"}
            assert {one.model.version for one in scene.models} == {"1.0.0"}
            assert {one.model.version for one in await client.model_consistency()} == {"1.0.0"}
        sets = frames - 12
        name = "forecast_displacement_error_meters_count"
        await until(lambda: value(server, name, model=NAME, horizon="6") == sets)
        assert value(server, name, model="fake", horizon="6") == sets
        for model in ("fake", NAME):
            assert value(server, "forecast_dispersion_meters_count", model=model) == sets
            assert value(server, "forecast_agents_total", model=model, status="ok") == frames
        assert value(server, "forecast_inference_seconds_count", model=NAME) == frames
        assert calls(server) == {"done": frames, "dropped": 0, "failed": 0}


async def test_a_forecast_of_the_shadow_has_waited_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    waited: list[float] = []

    def record(publisher: Publisher, request: object, plan: Plan, instants: object) -> None:
        waited.extend(group.outcome.queue for group in plan.groups if group.outcome is not None)

    monkeypatch.setattr(Publisher, "shadowed", record)
    async with running(*pair(), **shadowed()) as server:
        request = make_request(2)
        request.scene_id = "street"
        await TRANSPORTS["grpc"](server, request)
        await until(lambda: bool(waited))
    assert waited == [0.0]


async def test_under_load_no_answer_is_lost_or_mixed_and_the_shadow_gives_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("service.predict.shadow._MAX_CALLS", 2)
    monkeypatch.setattr("service.predict.shadow._MAX_AGE", 0.05)
    old, new = pair()
    sizes = count(1)

    async def call_often(server: Server, transport: str) -> list[tuple[int, pb.PredictResponse]]:
        answers = []
        for _ in range(10):
            agents = next(sizes) % 5 + 1
            answers.append((agents, await TRANSPORTS[transport](server, make_request(agents))))
        return answers

    async with running(old, new, **shadowed()) as server:
        async with asyncio.timeout(60):
            found: Sequence[list[tuple[int, pb.PredictResponse]]] = await asyncio.gather(
                *(call_often(server, transport) for transport in ("grpc", "rest") for _ in range(2))
            )
        for agents, response in (one for answers in found for one in answers):
            assert [len(forecast.weights) for forecast in response.forecasts] == [4] * agents
            assert response.model.version == "1.0.0"
        await until(lambda: sum(calls(server).values()) == 40)
        assert calls(server)["failed"] == 0
        assert calls(server)["dropped"] > 0


async def test_calls_that_arrive_while_the_shadow_is_in_the_model_are_answered() -> None:
    old, new = pair()
    async with running(old, new, **shadowed()) as server:
        new.free.clear()
        await call_grpc(server, make_request(1))
        assert await asyncio.to_thread(new.entered.wait, 10)
        waiting = [asyncio.create_task(call_grpc(server, make_request(1))) for _ in range(3)]
        await until(lambda: not server.dataplane._batcher.is_free)
        new.free.set()
        for response in await asyncio.gather(*waiting):
            assert response.model.version == "1.0.0"


async def test_a_share_is_of_scenes() -> None:
    async with running(*pair(), **shadowed("0.3")) as server:
        shadow = server.dataplane._pipeline.shadow
        assert shadow is not None
        chosen = [shadow._is_chosen(f"scene {number}") for number in range(2000)]
        assert 500 < sum(chosen) < 700
        assert chosen == [shadow._is_chosen(f"scene {number}") for number in range(2000)]
        without = Counter(shadow._is_chosen("") for _ in range(2000))
        assert 450 < without[True] < 750


async def test_a_shadow_that_fails_harms_nobody() -> None:
    old, new = pair()
    async with running(old, new, **shadowed()) as server:
        new.broken = True
        assert (await call_grpc(server, make_request(1))).model.version == "1.0.0"
        await until(lambda: calls(server)["failed"] == 1)
        new.broken = False
        new.nan_beyond = -1.0
        assert (await call_grpc(server, make_request(3))).model.version == "1.0.0"
        await until(lambda: calls(server)["done"] == 1)
        assert value(server, "forecast_nonfinite_total", model=NAME) == 3
        blind = make_request(1, context=pb.CONTEXT_BLIND)
        own = make_request(1, model=NAME)
        for request in (blind, own):  # nothing to compare
            await call_grpc(server, request)
        await call_grpc(server, make_request(1))
        await until(lambda: calls(server)["done"] == 2)


async def test_a_shadow_that_comes_with_a_reload() -> None:
    old, new = pair()
    models = [old]

    def load(_: Models | None) -> Registry:
        return registry(*models)

    server = Server(settings(**shadowed()), load=load)
    with capture_logs() as logs:
        await server.start()
    try:
        assert any(NAME in entry.get("reason", "") for entry in logs if entry["event"] == "no shadow model")
        await call_grpc(server, make_request(1))
        models.append(new)
        await server.dataplane.reload()
        await call_grpc(server, make_request(1))
        await until(lambda: calls(server) == {"done": 1, "dropped": 0, "failed": 0})
    finally:
        await server.stop()


async def test_a_map_that_is_named_by_its_digest_is_seen() -> None:
    async with running(*pair(), **shadowed()) as server:
        raster = scene_raster(np.ones((3, 200, 200), dtype=np.bool_), (-30, -30))
        async with AsyncClient(server.grpc_address, timeout=20) as client:
            for frame in range(3):  # from the second one on by its digest alone
                request = pb.PredictRequest(scene_id="street", time=NOW + 0.5 * frame, scene_raster=raster)
                add_agent(request, x=2.5 * frame)
                await client.predict(request)
        await until(lambda: sum(calls(server).values()) == 3)
        assert calls(server) == {"done": 3, "dropped": 0, "failed": 0}
