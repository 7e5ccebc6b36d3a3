"""Whole calls without a transport: who forecasts whom, and what the answer says of it."""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.forecaster import Context, Protocol
from model.scenes.scene import AgentType
from service.errors import BadField, BadFields, DeadlineExceeded, Overloaded, Unavailable, UnknownModel
from service.lifecycle import Phase
from service.predict.dataplane import DataPlane
from service.predict.request_reader import EncodedRequest
from service.settings import FALLBACK_MODEL, SettingsError
from service.telemetry.metrics import Metrics
from tests.service.fakes import FakeForecaster, registry
from tests.service.requests import CYCLIST, NOW, PEDESTRIAN, add_agent, make_request, pack
from tests.service.servers import settings

OK = pb.FORECAST_STATUS_OK
SHORT = pb.FORECAST_STATUS_SHORT_HISTORY
FALLBACK = pb.FORECAST_STATUS_FALLBACK
INVALID = pb.FORECAST_STATUS_INVALID


@asynccontextmanager
async def opened(*forecasters: FakeForecaster, **values: Any) -> AsyncIterator[DataPlane]:
    """A data plane, the default of which is the first forecaster."""
    named = {"default_model": forecasters[0].info.name} if forecasters else {}
    plane = DataPlane(settings(**(named | values)), Metrics())
    await plane.open(lambda _: registry(*forecasters))
    for forecaster in forecasters:
        forecaster.forget()
    try:
        yield plane
    finally:
        await plane.close()


async def predict(
    request: pb.PredictRequest, *forecasters: FakeForecaster, **values: Any
) -> pb.PredictResponse:
    async with opened(*forecasters, **values) as plane:
        return await plane.predict(request)


def means(forecast: pb.AgentForecast, response: pb.PredictResponse) -> np.ndarray[Any, Any]:
    return np.array(forecast.means).reshape(-1, response.steps, 2)


async def test_a_plain_forecast() -> None:
    response = await predict(make_request(2), FakeForecaster())
    assert [forecast.agent_id for forecast in response.forecasts] == ["a0", "a1"]
    assert (response.time, response.steps, response.step, response.seed) == (NOW, 12, 0.5, 0)
    assert (response.model.name, response.model.version) == ("fake", "1.0.0")
    assert response.model.protocol == models_pb.INPUT_PROTOCOL_CAUSAL
    assert response.timing.batch_agents == 2
    assert response.timing.inference > 0
    assert list(response.warnings) == []
    forecast = response.forecasts[1]
    assert (forecast.status, forecast.detail, forecast.field) == (OK, "", "")
    assert forecast.model == response.model
    assert forecast.history_frames == 3
    assert list(forecast.mode_ids) == [0, 1, 2, 3]
    assert list(forecast.weights) == pytest.approx(np.exp([1, 2, 3, 4]) / np.exp([1, 2, 3, 4]).sum())
    assert forecast.most_likely_mode == 3
    assert forecast.remaining_weight == 0
    expected = 0.5 * np.arange(1, 13)[:, None] * [5.0, 0.0] + [0.0, 4.0]
    assert means(forecast, response)[0] == pytest.approx(expected, abs=1e-4)
    assert np.array(forecast.covariances).reshape(4, 12, 3)[2, 3].tolist() == [2.0, 0.0, 2.0]


async def test_modes_are_cut_in_the_models_order() -> None:
    response = await predict(make_request(1, max_modes=2), FakeForecaster())
    [forecast] = response.forecasts
    assert list(forecast.mode_ids) == [2, 3]
    assert forecast.most_likely_mode == 1
    assert sum(forecast.weights) + forecast.remaining_weight == pytest.approx(1)
    assert means(forecast, response).shape == (2, 12, 2)
    assert means(forecast, response)[1, 0, 0] == pytest.approx(2.5 * 1.3)


@pytest.mark.parametrize("most", [4, 5, 2**32 - 1])
async def test_more_modes_than_there_are(most: int) -> None:
    [forecast] = (await predict(make_request(1, max_modes=most), FakeForecaster())).forecasts
    assert len(forecast.weights) == 4
    assert forecast.remaining_weight == 0


async def test_merged_modes() -> None:
    """At 6 s the heaviest mode is at 39 m, the others at 36, 33 and 30: within 7.8 m are the first two."""
    async with opened(FakeForecaster()) as plane:
        response = await plane.predict(make_request(2, merge=True, samples=4, seed=3))
        plain = await plane.predict(make_request(2, samples=4, seed=3))
    weights = np.exp([1, 2, 3, 4]) / np.exp([1, 2, 3, 4]).sum()
    for forecast, unmerged in zip(response.forecasts, plain.forecasts, strict=True):
        assert list(forecast.mode_ids) == [0, 3]
        assert list(forecast.weights) == pytest.approx([weights[0], weights[1:].sum()])
        assert (forecast.most_likely_mode, forecast.remaining_weight) == (1, 0)
        assert means(forecast, response).tolist() == means(unmerged, plain)[[0, 3]].tolist()
        own, merged = np.array(forecast.covariances).reshape(2, 12, 3)[:, -1]
        assert own.tolist() == [6.0, 0.0, 6.0]
        spread = (weights[1:] * np.array([6.0, 3.0, 0.0]) ** 2).sum() / weights[1:].sum()
        assert merged.tolist() == pytest.approx([6.0 + spread, 0.0, 6.0], abs=1e-4)
        assert list(forecast.samples) == list(unmerged.samples)


async def test_merging_changes_nothing_that_is_remembered_or_counted() -> None:
    """The agent drives by the mode of 1.1 times its stated speed, which merging leaves out of the answer."""
    layers = np.ones((3, 40, 8), dtype=np.uint8)
    told, off_road = [], []
    for merge in (False, True):
        metrics = Metrics()
        plane = DataPlane(settings(default_model="fake"), metrics)
        await plane.open(lambda _: registry(FakeForecaster()))
        for tick in range(16):
            request = pb.PredictRequest(time=NOW + 0.5 * tick, scene_id="s")
            request.options.consistency, request.options.merge = True, merge
            agent = add_agent(request, x=2.75 * tick, speed=5.5)
            for state in agent.states:
                state.velocity_x, state.velocity_y = 5.0, 0.0
            raster = request.scene_raster
            raster.rows, raster.columns, raster.image.packed_bits = 40, 8, pack(layers)
            raster.origin_x, raster.origin_y, raster.pixels_per_meter = -20.0, -4.0, 1.0
            [forecast] = (await plane.predict(request)).forecasts
        await plane.close()
        told.append(forecast.consistency)
        off_road.append(metrics.off_road.labels("fake")._value.get())
    assert told[0].complete
    assert told[0].errors[-1].displacement_error == pytest.approx(6.0, abs=1e-3)
    assert told[0] == told[1]
    assert off_road[0] == off_road[1] > 10


async def test_of_merged_modes_the_likeliest_are_returned() -> None:
    response = await predict(make_request(1, merge=True, max_modes=1), FakeForecaster())
    [forecast] = response.forecasts
    assert list(forecast.mode_ids) == [3]
    assert means(forecast, response).shape == (1, 12, 2)
    assert forecast.weights[0] + forecast.remaining_weight == pytest.approx(1)
    assert forecast.remaining_weight > 0.01
    [all_of_them] = (await predict(make_request(1, merge=True, max_modes=2), FakeForecaster())).forecasts
    assert (list(all_of_them.mode_ids), all_of_them.remaining_weight) == ([0, 3], 0)


async def test_agents_have_as_many_merged_modes_as_they_differ() -> None:
    """In one batch: of a slow agent all modes are near each other; a fallback has one."""
    request = make_request(1, merge=True)
    add_agent(request, "slow", y=9.0, speed=1.0)
    add_agent(request, "bike", CYCLIST, y=20.0)
    for most in (0, 1, 2, 3):
        request.options.max_modes = most
        response = await predict(request, FakeForecaster())
        fast, slow, bike = response.forecasts
        assert bike.status == FALLBACK
        assert list(fast.mode_ids) == ([3] if most == 1 else [0, 3])
        assert [list(one.mode_ids) for one in (slow, bike)] == [[3], [0]]
        for forecast in (slow, bike):
            assert list(forecast.weights) == pytest.approx([1])
            assert forecast.most_likely_mode == 0
            assert forecast.remaining_weight == pytest.approx(0, abs=1e-6)
            assert means(forecast, response).shape == (1, 12, 2)
            assert len(forecast.covariances) == 36


@pytest.mark.parametrize("horizon", [0.5, 3.0, 6.0])
async def test_horizon(horizon: float) -> None:
    response = await predict(make_request(1, horizon=horizon), FakeForecaster())
    assert response.steps == round(2 * horizon)
    assert means(response.forecasts[0], response).shape == (4, response.steps, 2)


async def test_samples_hang_on_seed_and_agent_alone() -> None:
    async with opened(FakeForecaster()) as plane:
        alone = await plane.predict(make_request(1, samples=5, seed=3))
        many = make_request(4, samples=5, seed=3)
        many.agents.reverse()
        together, again = await asyncio.gather(plane.predict(many), plane.predict(many))
        other = await plane.predict(make_request(1, samples=5, seed=4))
        drawn = await plane.predict(make_request(1, samples=5))
        redrawn = await plane.predict(make_request(1, samples=5, seed=drawn.seed))
    assert together.forecasts[3].agent_id == "a0"
    assert list(together.forecasts[3].samples) == list(alone.forecasts[0].samples)
    assert [list(f.samples) for f in together.forecasts] == [list(f.samples) for f in again.forecasts]
    assert list(other.forecasts[0].samples) != list(alone.forecasts[0].samples)
    assert list(redrawn.forecasts[0].samples) == list(drawn.forecasts[0].samples)
    assert len(alone.forecasts[0].samples) == 5 * 12 * 2
    assert alone.seed == 3
    offsets = [
        np.array(f.samples).reshape(5, 12, 2)[:, :, 1] - 4 * i
        for i, f in enumerate(reversed(together.forecasts))
    ]
    assert not np.allclose(offsets[0], offsets[1])  # agents do not share their noise


async def test_zero_is_a_seed() -> None:
    async with opened(FakeForecaster()) as plane:
        first = await plane.predict(make_request(1, samples=2, seed=0))
        second = await plane.predict(make_request(1, samples=2, seed=0))
    assert first.seed == 0
    assert list(first.forecasts[0].samples) == list(second.forecasts[0].samples)


async def test_types_that_the_model_does_not_know_fall_back() -> None:
    request = make_request(1)
    add_agent(request, "bike", CYCLIST, y=10)
    add_agent(request, "walker", PEDESTRIAN, y=20)
    response = await predict(request, FakeForecaster())
    assert [forecast.status for forecast in response.forecasts] == [OK, FALLBACK, OK]
    bike = response.forecasts[1]
    assert bike.model.name == FALLBACK_MODEL
    assert bike.detail == f"forecast by {FALLBACK_MODEL}: fake does not forecast agents of type cyclist"
    assert bike.field == ""
    assert response.model.name == "fake"
    assert means(bike, response)[0, -1] == pytest.approx([30, 10], abs=1e-3)


async def test_a_heading_that_nobody_can_tell_falls_back() -> None:
    fake = FakeForecaster(needs_heading=True)
    request = make_request(1)
    parked = add_agent(request, "parked", speed=0.0, y=8)
    for state in parked.states:
        state.ClearField("heading")
    response = await predict(request, fake)
    assert [forecast.status for forecast in response.forecasts] == [OK, FALLBACK]
    assert "heading neither given nor to be told from motion" in response.forecasts[1].detail


async def test_short_history() -> None:
    request = make_request(1)
    add_agent(request, "new", frames=2, y=8)
    response = await predict(request, FakeForecaster())
    new = response.forecasts[1]
    assert (new.status, new.detail, new.history_frames) == (SHORT, "2 of 3 frames", 2)
    assert len(new.means) == 4 * 12 * 2


async def test_a_single_state_needs_its_velocity() -> None:
    request = pb.PredictRequest(time=NOW)
    add_agent(request, "unknown", frames=1)
    known = add_agent(request, "known", frames=1)
    known.states[0].velocity_x, known.states[0].velocity_y = 1.0, 0.0
    response = await predict(request, FakeForecaster())
    assert [(f.status, f.field) for f in response.forecasts] == [(INVALID, "agents[0].states"), (SHORT, "")]
    assert response.forecasts[0].detail == (
        "a single state needs its velocity, or another state 0.05 s to 1.05 s before it"
    )


async def test_a_bad_agent_costs_nobody_else() -> None:
    request = make_request(3)
    good = await predict(request, FakeForecaster())
    request.agents[1].states[2].x = float("inf")
    response = await predict(request, FakeForecaster())
    bad = response.forecasts[1]
    assert (bad.status, bad.field) == (INVALID, "agents[1].states[2].x")
    assert bad.detail == "must be a finite number"
    assert len(bad.means) == len(bad.weights) == bad.history_frames == 0
    assert not bad.HasField("model")
    for index in (0, 2):
        assert list(response.forecasts[index].means) == list(good.forecasts[index].means)


async def test_neighbors_get_no_forecast_but_are_seen() -> None:
    fake = FakeForecaster()
    request = make_request(3)
    request.agents[0].predict = False
    request.agents[2].predict = True
    response = await predict(request, fake)
    assert [forecast.agent_id for forecast in response.forecasts] == ["a1", "a2"]
    assert len(fake.scenes[-1].types) == 3


async def test_invalid_neighbors_are_told() -> None:
    fake = FakeForecaster()
    request = make_request(3)
    request.agents[0].predict = False
    request.agents[0].states[0].y = float("nan")
    response = await predict(request, fake)
    assert [(f.agent_id, f.status) for f in response.forecasts] == [("a0", INVALID), ("a1", OK), ("a2", OK)]
    assert len(fake.scenes[-1].types) == 2


async def test_nobody_to_forecast() -> None:
    fake = FakeForecaster()
    assert list((await predict(make_request(0), fake)).forecasts) == []
    only_context = make_request(1)
    only_context.agents[0].predict = False
    assert list((await predict(only_context, fake)).forecasts) == []
    only_bad = make_request(1)
    only_bad.agents[0].ClearField("type")
    response = await predict(only_bad, fake)
    assert [forecast.status for forecast in response.forecasts] == [INVALID]
    assert response.timing.batch_agents == 0


async def test_scene_has_the_models_frames_only() -> None:
    fake = FakeForecaster(history_frames=2)
    await predict(make_request(1), fake)
    assert fake.scenes[-1].states.frames == 2


async def test_map_reaches_the_model() -> None:
    fake = FakeForecaster(uses_map=True)
    layers = np.zeros((3, 100, 100), dtype=np.uint8)
    layers[0, :10] = 1
    request = make_request(3)
    request.agents[0].states[0].x = float("nan")
    request.agents[2].map_patch.image.packed_bits = pack(layers)
    request.agents[1].far_map_patch.image.packed_bits = pack(1 - layers)
    without = await predict(request, fake)
    assert without.warnings == [
        "fake uses the map, but none was given for 1 of 2 agents: it saw an unknown one"
    ]
    assert list(fake.scenes[-1].patches) == [1]
    assert np.array_equal(fake.scenes[-1].patches[1], layers)  # the second of the usable agents
    assert list(fake.scenes[-1].far_patches) == [0]
    assert np.array_equal(fake.scenes[-1].far_patches[0], 1 - layers)
    raster = request.scene_raster
    raster.rows = raster.columns = 100
    raster.origin_x, raster.origin_y, raster.pixels_per_meter = -3.0, 7.0, 2.0
    raster.image.packed_bits = pack(layers)
    response = await predict(request, fake)
    assert list(response.warnings) == []
    seen = fake.scenes[-1].raster
    assert seen is not None
    assert np.array_equal(seen.layers, layers)
    assert (seen.origin.tolist(), seen.pixels_per_meter) == ([-3.0, 7.0], 2.0)


async def test_types_that_look_at_no_map_lack_none() -> None:
    fake = FakeForecaster(uses_map=True, map_types=(AgentType.VEHICLE,))
    request = make_request(2)
    add_agent(request, "walker", PEDESTRIAN, y=20)
    response = await predict(request, fake)
    assert response.warnings == [
        "fake uses the map, but none was given for 2 of 2 agents: it saw an unknown one"
    ]
    del request.agents[:2]
    assert (await predict(request, fake)).warnings == []


async def test_a_blind_forecast_needs_no_map() -> None:
    fake = FakeForecaster(uses_map=True)
    response = await predict(make_request(1, context=pb.CONTEXT_BLIND), fake)
    assert list(response.warnings) == []
    assert fake.batches[-1][2] is Context.BLIND


async def test_paper_protocol_warns() -> None:
    response = await predict(make_request(1), FakeForecaster(protocol=Protocol.PAPER))
    assert response.model.protocol == models_pb.INPUT_PROTOCOL_PAPER
    assert "trained by the paper protocol" in response.warnings[0]


async def test_numbers_that_are_not_finite_are_never_sent() -> None:
    fake = FakeForecaster()
    request = make_request(1)
    add_agent(request, "far", x=5000.0)
    async with opened(fake) as plane:
        fake.nan_beyond = 1000.0
        response = await plane.predict(request)
        assert [forecast.status for forecast in response.forecasts] == [OK, FALLBACK]
        assert response.forecasts[1].model.name == FALLBACK_MODEL
        assert "not finite" in response.forecasts[1].detail
        assert np.isfinite(response.forecasts[1].means).all()
        request.options.strict = True
        with pytest.raises(BadFields):
            await plane.predict(request)


async def test_when_even_the_fallback_fails() -> None:
    fake = FakeForecaster(FALLBACK_MODEL, version="2.0.0")  # newer, so it is the one
    request = make_request(1)
    add_agent(request, "far", x=5000.0)
    async with opened(fake, default_model=FALLBACK_MODEL) as plane:
        fake.nan_beyond = 1000.0
        response = await plane.predict(request)
    assert [forecast.status for forecast in response.forecasts] == [OK, INVALID]
    assert response.forecasts[1].field == "agents[1]"


async def test_strict_refuses_fallback() -> None:
    request = make_request(1, strict=True)
    add_agent(request, "bike", CYCLIST)
    with pytest.raises(BadFields) as caught:
        await predict(request, FakeForecaster())
    assert [fault.field for fault in caught.value.faults] == ["agents[1].type"]


async def test_strict_lets_short_history_through() -> None:
    request = pb.PredictRequest(time=NOW, options=pb.PredictOptions(strict=True))
    add_agent(request, frames=2)
    assert (await predict(request, FakeForecaster())).forecasts[0].status == SHORT


def change_raster(**values: Any) -> Callable[[pb.PredictRequest], None]:
    def change(request: pb.PredictRequest) -> None:
        raster = request.scene_raster
        raster.rows, raster.columns = 2, 2
        raster.origin_x, raster.origin_y, raster.pixels_per_meter = 0.0, 0.0, 1.0
        raster.image.packed_bits = bytes(2)
        for name, value in values.items():
            if value is None:
                raster.ClearField(name)  # type: ignore[arg-type]
            else:
                setattr(raster, name, value)

    return change


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda r: r.ClearField("time"), "time"),
        (lambda r: setattr(r, "time", float("nan")), "time"),
        (lambda r: setattr(r, "time", 1.1e10), "time"),
        (lambda r: setattr(r, "scene_id", "x" * 129), "scene_id"),
        (lambda r: setattr(r.options, "horizon", 0.0), "options.horizon"),
        (lambda r: setattr(r.options, "horizon", 0.7), "options.horizon"),
        (lambda r: setattr(r.options, "horizon", 6.5), "options.horizon"),
        (lambda r: setattr(r.options, "horizon", float("inf")), "options.horizon"),
        (lambda r: setattr(r.options, "samples", 2001), "options.samples"),
        (lambda r: setattr(r.options, "samples", 60), "options.samples"),
        (lambda r: setattr(r.options, "context", 9), "options.context"),
        (lambda r: setattr(r.options, "context", pb.CONTEXT_BLIND), "options.context"),
        (change_raster(origin_x=None), "scene_raster.origin_x"),
        (change_raster(origin_y=float("nan")), "scene_raster.origin_y"),
        (change_raster(origin_y=2e7), "scene_raster.origin_y"),
        (change_raster(pixels_per_meter=None), "scene_raster.pixels_per_meter"),
        (change_raster(pixels_per_meter=0.05), "scene_raster.pixels_per_meter"),
        (change_raster(rows=0), "scene_raster.rows"),
        (change_raster(columns=0), "scene_raster.columns"),
        (change_raster(rows=2**31, columns=2**31), "scene_raster.rows"),
        (change_raster(rows=3), "scene_raster.image.packed_bits"),
        (change_raster(image=None), "scene_raster.image"),
        (lambda r: r.scene_raster.SetInParent(), "scene_raster.origin_x"),
    ],
)
async def test_faults_of_the_call(change: Callable[[pb.PredictRequest], None], field: str) -> None:
    request = make_request(2)
    change(request)
    with pytest.raises(BadField) as caught:
        await predict(request, FakeForecaster(supports_blind=False), max_samples_per_call=100)
    assert [fault.field for fault in caught.value.faults] == [field]


async def test_models_by_name_and_version() -> None:
    async with opened(FakeForecaster(), FakeForecaster(version="2.0.0")) as plane:
        newest = await plane.predict(make_request(1))
        pinned = await plane.predict(make_request(1, model="fake@1.0.0"))
        assert (newest.model.version, pinned.model.version) == ("2.0.0", "1.0.0")
        listed = (await plane.list_models(models_pb.ListModelsRequest())).models
        assert [m.version for m in listed if m.name == "fake"] == ["1.0.0", "2.0.0"]
        assert [(m.name, m.version) for m in listed if m.is_default] == [("fake", "2.0.0")]
        got = (await plane.get_model(models_pb.GetModelRequest(name="fake"))).model
        assert got == next(m for m in listed if m.is_default)
        assert (got.horizon, got.step, got.modes, got.history_frames) == (6.0, 0.5, 4, 3)
        assert dict(got.benchmark) == {"fde_ml_6s_m": 1.5}
        with pytest.raises(UnknownModel):
            await plane.get_model(models_pb.GetModelRequest(name="nobody"))
        with pytest.raises(BadField):
            await plane.get_model(models_pb.GetModelRequest())


async def test_default_model() -> None:
    async with opened() as plane:
        assert (await plane.predict(make_request(1))).model.name == "kalman"
    async with opened(FakeForecaster("cab"), default_model=None) as plane:
        assert (await plane.predict(make_request(1))).model.name == "cab"
    with pytest.raises(SettingsError, match="nobody"):
        async with opened(default_model="nobody"):
            pass


async def test_fallback_must_reach_as_far() -> None:
    with pytest.raises(SettingsError, match="further"):
        async with opened(FakeForecaster(steps=16)):
            pass


async def test_warm_up_meets_every_shape_of_the_default_model() -> None:
    fake, other = FakeForecaster(), FakeForecaster("other", supports_blind=False)
    plane = DataPlane(settings(default_model="fake", max_batch_agents=6, threads=1), Metrics())
    await plane.open(lambda _: registry(fake, other))
    await plane.close()
    limits = [agents for kind, agents, context, _ in fake.batches if context is Context.BLIND]
    assert limits == [1, 2, 4, 6] * 2  # vehicles and pedestrians
    assert [agents for _, agents, _, _ in other.batches] == [1] * 2


def slow(seconds: float) -> EncodedRequest[pb.PredictRequest]:
    """A request that takes so long to read."""

    def read(_: bytes) -> pb.PredictRequest:
        time.sleep(seconds)
        return make_request(1)

    return EncodedRequest(b"", read, inline_bytes=-1)


async def test_time_in_the_queue_is_all_the_time_before_the_model() -> None:
    async with opened(FakeForecaster()) as plane:
        response = await plane.predict(slow(0.2))
    assert 0.2 <= response.timing.queue < 5


async def test_the_deadline_holds_for_reading_too() -> None:
    async with opened(FakeForecaster(), max_timeout=0.1) as plane:
        started = time.monotonic()
        with pytest.raises(DeadlineExceeded):
            await plane.predict(slow(3.0))
        assert time.monotonic() - started < 2.8


async def test_the_earlier_deadline_holds() -> None:
    async with opened(FakeForecaster(), max_timeout=5) as plane:
        now = asyncio.get_running_loop().time()
        for timeout, seconds in ((None, 5), (2, 2), (100, 5)):
            with plane.accept(timeout) as call:
                assert call.deadline - now == pytest.approx(seconds, abs=0.5)


async def test_a_drain_waits_until_the_answer_is_out() -> None:
    async with opened(FakeForecaster()) as plane:
        with plane.accept() as call:
            assert not await plane.drain(0.01)
            with pytest.raises(Unavailable), plane.accept():
                pass
            assert (await plane.predict(make_request(1), call)).forecasts
            assert not await plane.drain(0.01)  # the answer is still to be sent
        assert await plane.drain(0.01)


async def test_calls_are_refused_before_they_are_read() -> None:
    fake = FakeForecaster()
    async with opened(fake, max_agents=1, max_queue_agents=1) as plane:
        fake.free.clear()
        calls = [asyncio.create_task(plane.predict(make_request(1)))]
        assert await asyncio.to_thread(fake.entered.wait, 10)
        calls.append(asyncio.create_task(plane.predict(make_request(1))))
        await asyncio.sleep(0.1)
        with pytest.raises(Overloaded), plane.accept():
            pass
        fake.free.set()
        await asyncio.gather(*calls)


async def test_phases() -> None:
    fake = FakeForecaster()
    plane = DataPlane(settings(default_model="fake"), Metrics())
    assert plane.phase is Phase.STARTING
    with pytest.raises(Unavailable, match="starting"):
        await plane.predict(make_request(1))
    await plane.open(lambda _: registry(fake))
    fake.forget()
    fake.free.clear()
    call = asyncio.create_task(plane.predict(make_request(1)))
    assert await asyncio.to_thread(fake.entered.wait, 10)
    assert not await plane.drain(0.01)
    assert str(plane.phase) == Phase.DRAINING
    with pytest.raises(Unavailable, match="draining"):
        await plane.list_models(models_pb.ListModelsRequest())
    fake.free.set()
    assert await plane.drain(10)
    assert len((await call).forecasts) == 1
    await plane.close()
