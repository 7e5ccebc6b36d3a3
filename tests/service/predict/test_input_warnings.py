"""Input that lies is said: each lie over both transports, with the code and the field of its warning."""

import json
from collections.abc import Callable

import httpx
import numpy as np
import pytest

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.scenes.plausibility import Contradiction
from service.predict.input_warnings import CODES, code_name, code_names
from service.server import Server
from tests.service.fakes import FakeForecaster
from tests.service.requests import CYCLIST, NOW, VEHICLE, add_agent, make_request, pack
from tests.service.servers import TRANSPORTS, CallError, from_problem, running

OK, INVALID = pb.FORECAST_STATUS_OK, pb.FORECAST_STATUS_INVALID
both_transports = pytest.mark.parametrize("transport", TRANSPORTS)
Found = list[tuple[str, str]]


def found(forecast: pb.AgentForecast) -> Found:
    """Return code and field of each warning."""
    return [(code_name(warning.code), warning.field) for warning in forecast.warnings]


def counted(server: Server, code: str) -> float | None:
    """Return the number of warnings with that code."""
    return server.metrics.registry.get_sample_value("forecast_input_warnings_total", {"code": code})


def each_state(change: Callable[[pb.AgentState], None]) -> Callable[[pb.PredictRequest], None]:
    """Return a change of all states of the first agent."""

    def apply(request: pb.PredictRequest) -> None:
        for state in request.agents[0].states:
            change(state)

    return apply


def backwards(state: pb.AgentState) -> None:
    state.velocity_x, state.velocity_y = -5.0, 0.0


def across(state: pb.AgentState) -> None:
    state.heading = 1.6


def degrees(state: pb.AgentState) -> None:
    state.heading = 359.0


def flipped(request: pb.PredictRequest) -> None:
    request.agents[0].states[4].heading = np.pi


def another(request: pb.PredictRequest) -> None:
    for state in request.agents[0].states:
        state.x, state.heading = 0.0, 0.0
    request.agents[0].states[5].y = 40.0


def nanoseconds(request: pb.PredictRequest) -> None:
    for state in request.agents[0].states:
        state.time = NOW + (state.time - NOW) * 1e9
        state.velocity_x, state.velocity_y = 5.0, 0.0


def map_elsewhere(request: pb.PredictRequest) -> None:
    raster = request.scene_raster
    raster.image.packed_bits = pack(np.ones((3, 30, 30), dtype=np.uint8))
    raster.rows = raster.columns = 30
    raster.origin_x, raster.origin_y, raster.pixels_per_meter = 500.0, 500.0, 1.0


LIES: dict[str, tuple[Callable[[pb.PredictRequest], None], Found]] = {
    "velocity": (each_state(backwards), [("velocity_mismatch", "agents[0].states[5].velocity_x")]),
    "heading": (each_state(across), [("heading_mismatch", "agents[0].states[5].heading")]),
    "degrees": (each_state(degrees), [("heading_in_degrees", "agents[0].states[5].heading")]),
    "flip": (flipped, [("heading_flipped", "agents[0].states[4].heading")]),
    "another object": (another, [("other_object", "agents[0].states[5].x")]),
    "nanoseconds": (nanoseconds, [("time_unit", "agents[0].states[5].time")]),
    "map": (map_elsewhere, [("off_map", "scene_raster")]),
}


@both_transports
async def test_each_lie_is_said_and_counted(transport: str) -> None:
    async with running(FakeForecaster()) as server:
        call = TRANSPORTS[transport]
        assert not found((await call(server, make_request(1))).forecasts[0])
        for name, (lie, expected) in LIES.items():
            request = make_request(1)
            lie(request)
            [forecast] = (await call(server, request)).forecasts
            assert found(forecast) == expected, name
            assert forecast.status in (OK, pb.FORECAST_STATUS_SHORT_HISTORY), name
            assert all(warning.detail for warning in forecast.warnings)
        assert all(counted(server, code) == 1 for _, [(code, _)] in LIES.values())
        assert counted(server, "duplicate_id") == 0


def test_every_contradiction_has_a_code() -> None:
    assert set(CODES) == set(Contradiction)
    assert {code_name(code) for code in CODES.values()} < set(code_names())


@both_transports
async def test_two_agents_with_one_id_are_invalid_and_still_neighbours(transport: str) -> None:
    fake = FakeForecaster()
    async with running(fake) as server:
        request = make_request(3)
        request.agents[2].id = "a1"
        request.scene_id = "duplicates"
        for history in (pb.HISTORY_SOURCE_REQUEST, pb.HISTORY_SOURCE_MEMORY):
            request.options.history = history
            response = await TRANSPORTS[transport](server, request)
            assert [forecast.status for forecast in response.forecasts] == [OK, INVALID, INVALID]
            assert [forecast.field for forecast in response.forecasts[1:]] == ["agents[1].id", "agents[2].id"]
            assert [found(forecast) for forecast in response.forecasts] == [
                [],
                [("duplicate_id", "agents[1].id")],
                [("duplicate_id", "agents[2].id")],
            ]
            assert fake.scenes[-1].states.position[:, -1, 1].tolist() == [0.0, 4.0, 8.0]
            tracking = [forecast.tracking for forecast in response.forecasts]
            assert tracking[1:] == [consistency_pb.TRACKING_STATUS_UNSPECIFIED] * 2


@both_transports
async def test_what_the_track_memory_contradicts(transport: str) -> None:
    async with running(FakeForecaster()) as server:

        async def send(
            tick: float, kind: models_pb.AgentType.ValueType = VEHICLE, **where: float
        ) -> pb.AgentForecast:
            request = pb.PredictRequest(time=NOW + tick, scene_id="stream")
            agent = add_agent(request, "a", kind, frames=1, speed=0.0, **where)
            agent.states[0].velocity_x = agent.states[0].velocity_y = 0.0
            if "heading" in where:
                agent.states[0].heading = where["heading"]
            [forecast] = (await TRANSPORTS[transport](server, request)).forecasts
            return forecast

        assert [found(await send(0.5 * tick)) for tick in range(4)] == [[]] * 4
        wavering = await send(2.0, CYCLIST)
        assert found(wavering) == [("type_changed", "agents[0].type")]
        assert wavering.tracking == consistency_pb.TRACKING_STATUS_OK
        assert found(await send(2.5, CYCLIST)) == []
        for back in (0.06, 0.33):
            late = await send(2.5 - back, CYCLIST)
            assert found(late) == [("time_backwards", "time")]
            assert late.tracking == consistency_pb.TRACKING_STATUS_OK
        assert found(await send(2.5, CYCLIST)) == []  # repeated
        jumped = await send(3.5, CYCLIST, x=40.0)
        assert found(jumped) == [("other_object", "agents[0].states")]
        assert jumped.tracking == consistency_pb.TRACKING_STATUS_OK
        far = await send(4.0, CYCLIST, x=4000.0)
        assert found(far) == [("other_object", "agents[0].states")]
        assert far.tracking == consistency_pb.TRACKING_STATUS_RESET


@both_transports
async def test_lies_against_recalled_states(transport: str) -> None:
    async with running(FakeForecaster()) as server:
        answers = []
        for tick, x, heading in ((0, 0.0, 0.0), (1, 4.0, 0.0), (2, 8.0, np.pi), (3, 44.0, 0.0)):
            request = pb.PredictRequest(time=NOW + 0.5 * tick, scene_id="recalled")
            request.options.history = pb.HISTORY_SOURCE_MEMORY
            agent = add_agent(request, "a", frames=1, x=x)
            agent.states[0].heading = heading
            agent.states[0].velocity_x, agent.states[0].velocity_y = 8.0, 0.0
            [forecast] = (await TRANSPORTS[transport](server, request)).forecasts
            answers.append(found(forecast))
    assert answers[:3] == [[], [], [("heading_flipped", "agents[0].states[0].heading")]]
    assert answers[3] == [("other_object", "agents[0].states[0].x")]


@both_transports
async def test_context_agents_are_told_of_in_words(transport: str) -> None:
    async with running(FakeForecaster()) as server:
        request = make_request(2)
        each_state(backwards)(request)
        request.agents[0].predict = False
        response = await TRANSPORTS[transport](server, request)
        assert [found(forecast) for forecast in response.forecasts] == [[]]
        [text] = [text for text in response.warnings if "context agent" in text]
        assert text.startswith("agents[0].states[5].velocity_x of a context agent: 5 m/s")


@both_transports
async def test_times_in_nanoseconds_are_bad_fields_that_say_so(transport: str) -> None:
    async with running(FakeForecaster()) as server:
        request = make_request(2)
        request.agents[0].states[5].time = NOW * 1e9
        response = await TRANSPORTS[transport](server, request)
        assert [forecast.status for forecast in response.forecasts] == [INVALID, OK]
        assert response.forecasts[0].detail.endswith("it seems to be in nanoseconds")
        request.time = NOW * 1e3
        with pytest.raises(CallError) as caught:
            await TRANSPORTS[transport](server, request)
        assert [field for field, _ in caught.value.faults] == ["time"]
        assert caught.value.faults[0][1].endswith("it seems to be in milliseconds")


async def post(server: Server, body: str) -> httpx.Response:
    async with httpx.AsyncClient() as client:
        return await client.post(
            f"http://{server.http_address}/v1/predict",
            content=body,
            headers={"content-type": "application/json"},
        )


AGENTS = [
    {"id": name, "type": kind, "states": [{"time": 9.5, "x": 0, "y": 0}, {"time": 10, "x": 1, "y": 0}]}
    for name, kind in (("a", "AGENT_TYPE_SCOOTER"), ("b", "AGENT_TYPE_VEHICLE"), ("c", "1"))
]


async def test_an_unknown_name_of_a_type_costs_only_its_agent() -> None:
    async with running(FakeForecaster()) as server:
        response = await post(server, json.dumps({"time": 10, "agents": AGENTS}))
        unknown, *others = response.json()["forecasts"]
        assert (unknown["status"], unknown["field"]) == ("FORECAST_STATUS_INVALID", "agents[0].type")
        assert unknown["detail"].startswith("unknown name; it is one of AGENT_TYPE_VEHICLE, ")
        assert {one["status"] for one in others} == {"FORECAST_STATUS_SHORT_HISTORY"}


@pytest.mark.parametrize("constant", ["NaN", "Infinity", "-Infinity"])
async def test_a_bare_nan_is_answered_with_its_place(constant: str) -> None:
    body = json.dumps({"time": 10, "agents": AGENTS})
    at = body.rindex('"x": 1')
    async with running(FakeForecaster()) as server:
        response = await post(server, f'{body[:at]}"x": {constant}{body[at + 6 :]}')
        error = from_problem(response)
        assert (response.status_code, error.code) == (422, "INVALID_ARGUMENT")
        assert error.faults == [
            ("agents[2].states[1].x", "must be a finite number; NaN and Infinity are not JSON")
        ]
        broken = from_problem(await post(server, '{"time": NaN, '))
        assert [field for field, _ in broken.faults] == ["body"]
