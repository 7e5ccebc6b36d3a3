"""Explain over both transports: answers, refusals, its place behind Predict, and donors of the folder."""

import asyncio
import shutil
from collections.abc import AsyncIterator, Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import model
from cab.forecast.v1 import explanation_service_pb2 as pb
from cab.forecast.v1.prediction_service_pb2 import (
    FORECAST_STATUS_FALLBACK,
    FORECAST_STATUS_INVALID,
    FORECAST_STATUS_OK,
    FORECAST_STATUS_SHORT_HISTORY,
    PredictRequest,
    SceneRaster,
)
from cab_forecast import (
    AsyncClient,
    BadRequest,
    DeadlineExceeded,
    NotFound,
    Overloaded,
    TooLarge,
    UnknownRaster,
)
from cab_forecast.explanations import as_explain_request, explain_options
from model.explanation.donors import FILE, Donors, load_donors
from model.scenes.scene import AgentType
from service.predict.explanation import MAX_WAITING
from service.server import Server
from tests.model.checkpoints import copy_bundled
from tests.service.fakes import FakeForecaster
from tests.service.requests import CYCLIST, NOW, PEDESTRIAN, add_agent, make_request, pack
from tests.service.servers import count, running, settings, until

CHECKPOINTS = Path(model.__file__).parent / "checkpoints"
TRANSPORTS = ("grpc", "http")


@cache
def shipped() -> Donors:
    found = load_donors(CHECKPOINTS)
    assert found is not None
    return found


def client(server: Server, transport: str = "grpc", **values: Any) -> AsyncClient:
    address = server.grpc_address if transport == "grpc" else f"http://{server.http_address}"
    return AsyncClient(address, timeout=20, retries=0, **values)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of models with Trajectron++ and the donors."""
    place = tmp_path_factory.mktemp("models")
    copy_bundled(place / "trajectron", "trajectron")
    shutil.copy(CHECKPOINTS / FILE, place / FILE)
    return place


@pytest.fixture
async def server(folder: Path) -> AsyncIterator[Server]:
    made = Server(settings(models=folder, default_model="trajectron", max_batch_agents=8))
    await made.start()
    try:
        yield made
    finally:
        await made.stop()


def street(with_map: bool = True) -> PredictRequest:
    """Return a car behind a slower one, a pedestrian, a cyclist, and a car far away."""
    request = PredictRequest(time=NOW)
    add_agent(request, "car", speed=8.0)
    for agent_id, kind, x, y, speed in (
        ("ahead", request.agents[0].type, 15.0, 0.0, 3.0),
        ("walker", PEDESTRIAN, 10.0, 5.0, 1.0),
        ("far", request.agents[0].type, 90.0, 0.0, 3.0),
    ):
        add_agent(request, agent_id, kind, x=x, y=y, speed=speed).predict = False
    add_agent(request, "bike", CYCLIST, x=-10.0, y=3.0, speed=4.0)
    if with_map:
        layers = np.zeros((3, 200, 100), dtype=np.uint8)
        layers[0, :, 40:60] = 1
        raster = request.scene_raster
        raster.image.packed_bits = pack(layers)
        raster.rows, raster.columns = layers.shape[1:]
        raster.origin_x, raster.origin_y, raster.pixels_per_meter = -50.0, -25.0, 2.0
    return request


async def test_both_transports_answer_the_same(server: Server) -> None:
    request = as_explain_request(street(), explain_options(by_neighbor=True, draws=4, seed=3))
    answers = []
    for transport in TRANSPORTS:
        async with client(server, transport) as one:
            answers.append(await one.explain(request))
    async with client(server, "http", encoding="json") as one:
        answers.append(await one.explain(request))
    assert answers[0] == answers[1] == answers[2]
    [car, bike] = answers[0].explanations
    assert (car.agent_id, car.status) == ("car", FORECAST_STATUS_OK)
    assert (car.baseline, car.draws) == (pb.EXPLANATION_BASELINE_DONORS, 4)
    assert (car.model.name, answers[0].horizon, answers[0].time) == ("trajectron", 6.0, NOW)
    for part in (car.state, car.map, car.neighbors):
        assert part.nearer
        assert part.nearer_error > 0
    total = car.state.ahead + car.map.ahead + car.neighbors.ahead
    assert total == pytest.approx(car.end_point.x - car.base_point.x, abs=1e-6)
    assert {one.agent_id for one in car.by_neighbor} == {"ahead", "walker", "far", "bike"}
    sizes = [abs(one.value.nearer) for one in car.by_neighbor]
    assert sizes == sorted(sizes, reverse=True)
    values = {one.agent_id: one.value for one in car.by_neighbor}
    assert values["far"] == values["bike"] == pb.ShapleyValue()  # too far, and of a type that it does not see
    assert values["ahead"].nearer
    assert (bike.status, bike.model.name) == (FORECAST_STATUS_FALLBACK, "constant-velocity-yaw")
    assert bike.baseline == pb.EXPLANATION_BASELINE_NULL_CONTEXT
    assert bike.state.nearer == pytest.approx(4.0 * 6, abs=0.1)
    assert bike.map == bike.neighbors == pb.ShapleyValue()
    for transport in ("grpc", "rest"):
        assert count(server, transport, "Explain", "OK")


async def test_the_end_point_is_that_of_the_forecast(server: Server) -> None:
    request = street()
    request.options.max_modes = 1
    request.options.horizon = 3.0
    async with client(server) as one:
        forecast = (await one.predict(request)).forecasts[0]
        answer = await one.explain(as_explain_request(request))
    assert answer.horizon == 3.0
    end = answer.explanations[0].end_point
    assert forecast.means[-2:] == pytest.approx([end.x, end.y], abs=1e-3)


async def test_the_null_context_on_request(server: Server) -> None:
    async with client(server) as one:
        options = explain_options(baseline="null_context")
        answer = await one.explain(as_explain_request(street(), options))
    [car, _] = answer.explanations
    assert (car.baseline, car.draws) == (pb.EXPLANATION_BASELINE_NULL_CONTEXT, 0)
    assert not answer.warnings
    assert car.state.nearer_error == 0
    assert answer.forecasts <= 8 + 2


async def test_a_map_by_its_digest(server: Server) -> None:
    named = as_explain_request(street())
    named.scene_raster.CopyFrom(SceneRaster(digest=bytes(32)))
    async with client(server, map_by_digest=False) as one:
        with pytest.raises(UnknownRaster):
            await one.explain(named)
    async with client(server) as one:
        first = await one.explain(as_explain_request(street()))
        assert await one.explain(as_explain_request(street())) == first
    lookups = server.metrics.registry.get_sample_value
    assert lookups("forecast_raster_lookups_total", {"source": "memory"}) == 1


async def test_a_folder_without_donors_has_the_null_context_and_says_so(tmp_path: Path) -> None:
    copy_bundled(tmp_path / "trajectron", "trajectron")
    place = Server(settings(models=tmp_path, default_model="trajectron", max_batch_agents=8))
    await place.start()
    try:
        async with client(place) as one:
            answer = await one.explain(as_explain_request(street()))
            assert answer.explanations[0].baseline == pb.EXPLANATION_BASELINE_NULL_CONTEXT
            [warning] = answer.warnings
            assert "no donors" in warning
            (tmp_path / FILE).write_bytes(b"damaged")
            await one.reload_models()
            assert (await one.explain(as_explain_request(street()))).warnings == [warning]
            shutil.copy(CHECKPOINTS / FILE, tmp_path / FILE)
            await one.reload_models()
            answer = await one.explain(as_explain_request(street()))
            assert answer.explanations[0].baseline == pb.EXPLANATION_BASELINE_DONORS
            assert not answer.warnings
    finally:
        await place.stop()


async def test_agents_that_are_invalid_or_short_are_said() -> None:
    async with running(FakeForecaster(history_frames=5)) as server, client(server) as one:
        request = make_request(3)
        request.agents[1].states[0].x = np.nan
        del request.agents[2].states[:-2]
        answer = await one.explain(as_explain_request(request))
    statuses = [each.status for each in answer.explanations]
    assert statuses == [FORECAST_STATUS_OK, FORECAST_STATUS_INVALID, FORECAST_STATUS_SHORT_HISTORY]
    assert answer.explanations[1].field == "agents[1].states[0].x"
    assert answer.explanations[1].state == pb.ShapleyValue()
    assert answer.explanations[2].state.nearer > 0


async def test_forecasts_that_are_not_finite_are_invalid() -> None:
    fake = FakeForecaster(agent_types=(AgentType.VEHICLE,))
    async with running(fake) as server, client(server) as one:
        fake.nan_beyond = 10.0
        request = make_request(1)
        add_agent(request, "b", x=20.0)
        answer = await one.explain(as_explain_request(request))
    assert [each.status for each in answer.explanations] == [FORECAST_STATUS_OK, FORECAST_STATUS_INVALID]
    assert (answer.explanations[1].field, "not finite" in answer.explanations[1].detail) == (
        "agents[1]",
        True,
    )


def changed(change: Callable[[pb.ExplainRequest], object]) -> pb.ExplainRequest:
    request = as_explain_request(make_request(2))
    change(request)
    return request


BAD: dict[str, Callable[[pb.ExplainRequest], object]] = {
    "time": lambda request: request.ClearField("time"),
    "options.baseline": lambda request: setattr(request.options, "baseline", 7),
    "options.draws": lambda request: setattr(request.options, "draws", 33),
    "options.permutations": lambda request: setattr(request.options, "permutations", 7),
    "options.horizon": lambda request: setattr(request.options, "horizon", 0.7),
    "scene_raster.origin_x": lambda request: request.scene_raster.image.MergeFrom(
        street().scene_raster.image
    ),
}


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_refusals(transport: str) -> None:
    async with (
        running(FakeForecaster(), max_explained_agents=2, max_explanation_forecasts=20) as server,
        client(server, transport) as one,
    ):
        for field, change in BAD.items():
            with pytest.raises(BadRequest) as caught:
                await one.explain(changed(change))
            assert [violation.field for violation in caught.value.field_violations] == [field]
        with pytest.raises(NotFound, match="no model 'nobody'"):
            await one.explain(changed(lambda request: setattr(request, "model", "nobody")))
        with pytest.raises(TooLarge, match="3 agents to explain; at most 2"):
            await one.explain(as_explain_request(make_request(3)))
        few = make_request(3)
        few.agents[2].predict = False
        assert len((await one.explain(as_explain_request(few))).explanations) == 2
    async with running(FakeForecaster(), max_explanation_forecasts=10) as server, client(server) as one:
        with pytest.raises(BadRequest, match="16 forecasts, and at most 10") as caught:
            await one.explain(as_explain_request(make_request(2)))
        assert [violation.field for violation in caught.value.field_violations] == ["options.draws"]


async def test_forecasts_go_first() -> None:
    """While the model is busy explanations wait; a call of Predict that comes later is answered first."""
    fake = FakeForecaster()
    async with running(fake, max_batch_agents=8) as server, client(server) as one:
        fake.free.clear()
        held = asyncio.create_task(one.predict(make_request(1)))
        await until(fake.entered.is_set)
        explaining = asyncio.create_task(one.explain(as_explain_request(make_request(1))))
        late = asyncio.create_task(one.explain(as_explain_request(make_request(1)), timeout=0.2))
        with pytest.raises(DeadlineExceeded):
            await late
        later = asyncio.create_task(one.predict(make_request(1)))
        await asyncio.sleep(0.05)
        assert not explaining.done()
        fake.free.set()
        done, _ = await asyncio.wait({explaining, later}, return_when=asyncio.FIRST_COMPLETED)
        assert later in done
        await asyncio.gather(held, later, explaining)
        assert [agents for _, agents, _, _ in fake.batches[:2]] == [1, 1]  # those of Predict


async def test_few_explanations_wait() -> None:
    fake = FakeForecaster()
    async with running(fake) as server, client(server) as one:
        fake.free.clear()
        request = as_explain_request(make_request(1))
        waiting = [asyncio.create_task(one.explain(request)) for _ in range(MAX_WAITING + 1)]
        await until(fake.entered.is_set)
        await asyncio.sleep(0.1)
        with pytest.raises(Overloaded, match=f"{MAX_WAITING} explanations are waiting"):
            await one.explain(request)
        fake.free.set()
        await asyncio.gather(*waiting)
        assert (await one.explain(request)).explanations
