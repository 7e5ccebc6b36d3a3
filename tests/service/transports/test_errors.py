"""Every row of the error table, provoked on both transports."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
from typing import Any

import pytest

from cab.forecast.v1.consistency_service_pb2 import GetAgentConsistencyRequest
from service.errors import ServiceError, TrackingUnavailable, UnknownTrack
from service.settings import FALLBACK_MODEL
from tests.service.fakes import FakeForecaster
from tests.service.planes import with_fake_plane
from tests.service.requests import make_request
from tests.service.servers import GET_AGENT_BY, TRANSPORTS, CallError, running, until_waiting

Call = Callable[..., Coroutine[Any, Any, object]]
ASKED = GetAgentConsistencyRequest(scene_id="s", agent_id="a")


@pytest.fixture(params=TRANSPORTS)
def call(request: pytest.FixtureRequest) -> Call:
    """Return Predict over one of the transports."""
    return TRANSPORTS[request.param]


@pytest.fixture(params=GET_AGENT_BY)
def get_agent(request: pytest.FixtureRequest) -> Call:
    """Return GetAgentConsistency over one of the transports."""
    return GET_AGENT_BY[request.param]


async def failure(awaitable: Awaitable[object]) -> CallError:
    with pytest.raises(CallError) as caught:
        await awaitable
    return caught.value


def check(error: CallError, code: str, http_status: int, reason: str) -> None:
    assert (error.code, error.reason) == (code, reason)
    assert error.http_status in (None, http_status)


async def entered(forecaster: FakeForecaster) -> None:
    assert await asyncio.to_thread(forecaster.entered.wait, 10)


async def test_bad_field(call: Call) -> None:
    async with running() as server:
        request = make_request()
        request.ClearField("time")
        error = await failure(call(server, request))
        check(error, "INVALID_ARGUMENT", 422, "BAD_FIELD")
        assert error.faults == [("time", "is required")]
        assert error.message == "time: is required"
        assert error.retry_after is None


async def test_strict_names_every_agent(call: Call) -> None:
    async with running() as server:
        request = make_request(3, strict=True)
        request.agents[0].states[1].x = float("nan")
        request.agents[2].id = ""
        error = await failure(call(server, request))
        check(error, "INVALID_ARGUMENT", 422, "BAD_FIELD")
        assert error.faults == [
            ("agents[0].states[1].x", "must be a finite number"),
            ("agents[2].id", "is required"),
        ]


async def test_many_faults_fit_into_metadata(call: Call) -> None:
    async with running() as server:
        request = make_request(400, strict=True)
        for agent in request.agents:
            agent.states[3].time = 1e9
        error = await failure(call(server, request))
        check(error, "INVALID_ARGUMENT", 422, "BAD_FIELD")
        assert len(error.faults) > 20
        assert error.faults[0] == ("agents[0].states[3].time", "must be after the state before it")


async def test_no_message_at_all(call: Call) -> None:
    async with running() as server:
        error = await failure(call(server, b"\xff\xff\xff"))
        check(error, "INVALID_ARGUMENT", 422, "BAD_FIELD")
        assert error.faults[0][0] == "body"


@pytest.mark.parametrize("header", [{}, {"authorization": "Bearer wrong"}, {"authorization": "Basic right"}])
async def test_unauthenticated(call: Call, header: dict[str, str]) -> None:
    async with running(api_tokens=("right", "also-right")) as server:
        error = await failure(call(server, make_request(), header))
        check(error, "UNAUTHENTICATED", 401, "UNAUTHENTICATED")
        assert await call(server, make_request(), {"authorization": "Bearer also-right"})


@pytest.mark.parametrize("name", ["nobody", "kalman@99.0.0", "x" * 1000])
async def test_unknown_model(call: Call, name: str) -> None:
    async with running() as server:
        error = await failure(call(server, make_request(model=name)))
        check(error, "NOT_FOUND", 404, "UNKNOWN_MODEL")


async def test_unknown_raster(call: Call) -> None:
    async with running() as server:
        request = make_request()
        request.scene_raster.digest = bytes(range(32))
        error = await failure(call(server, request))
        check(error, "FAILED_PRECONDITION", 412, "UNKNOWN_RASTER")
        assert bytes(range(32)).hex() in error.message
        assert error.retry_after is None


@pytest.mark.parametrize(
    ("error", "row"),
    [
        (UnknownTrack("nothing is remembered"), ("NOT_FOUND", 404, "UNKNOWN_TRACK")),
        (TrackingUnavailable("no answer", 2.0), ("UNAVAILABLE", 503, "TRACKING_UNAVAILABLE")),
    ],
)
async def test_the_track_memorys_errors(
    get_agent: Call, error: ServiceError, row: tuple[str, int, str]
) -> None:
    async with running() as server:
        with_fake_plane(server).error = error
        found = await failure(get_agent(server, ASKED))
        check(found, *row)
        assert (found.message, found.retry_after) == (error.detail, error.retry_after)


async def test_of_nothing_nothing_is_remembered(get_agent: Call) -> None:
    async with running() as server:
        check(await failure(get_agent(server, ASKED)), "NOT_FOUND", 404, "UNKNOWN_TRACK")
        server.dataplane.refuse()
        check(await failure(get_agent(server, ASKED)), "UNAVAILABLE", 503, "UNAVAILABLE")


async def test_too_many_agents(call: Call) -> None:
    async with running(max_agents=3) as server:
        error = await failure(call(server, make_request(4)))
        check(error, "RESOURCE_EXHAUSTED", 413, "TOO_LARGE")
        assert error.retry_after is None


async def test_too_many_bytes(call: Call) -> None:
    async with running(max_request_bytes=2048) as server:
        error = await failure(call(server, make_request(12)))
        check(error, "RESOURCE_EXHAUSTED", 413, "TOO_LARGE")
        assert error.retry_after is None
        assert await call(server, make_request(1))


async def test_overloaded(call: Call) -> None:
    fake = FakeForecaster()
    async with running(fake, max_agents=2, max_queue_agents=2) as server:
        fake.free.clear()
        running_call = asyncio.create_task(call(server, make_request(2)))
        await entered(fake)
        queued_call = asyncio.create_task(call(server, make_request(2)))
        await until_waiting(server, 2)
        error = await failure(call(server, make_request(1)))
        check(error, "RESOURCE_EXHAUSTED", 429, "OVERLOADED")
        assert error.retry_after is not None
        assert 0 < error.retry_after <= 10
        fake.free.set()
        await asyncio.gather(running_call, queued_call)
        assert await call(server, make_request(1))


async def test_deadline_passes_in_the_queue(call: Call) -> None:
    fake = FakeForecaster()
    async with running(fake) as server:
        fake.free.clear()
        first = asyncio.create_task(call(server, make_request(1)))
        await entered(fake)
        error = await failure(call(server, make_request(2), timeout=0.15))
        # A gRPC client ends the call by itself, so that the server's details never reach it.
        assert error.code == "DEADLINE_EXCEEDED"
        assert error.http_status in (None, 504)
        await until_waiting(server, 0)
        fake.free.set()
        await first
        assert [agents for _, agents, _, _ in fake.batches] == [1]


async def test_the_servers_own_limit_on_time(call: Call) -> None:
    fake = FakeForecaster()
    async with running(fake, max_timeout=0.15) as server:
        fake.free.clear()
        error = await failure(call(server, make_request(1), timeout=10))
        check(error, "DEADLINE_EXCEEDED", 504, "DEADLINE_EXCEEDED")
        fake.free.set()


async def test_draining(call: Call) -> None:
    fake = FakeForecaster()
    async with running(fake) as server:
        fake.free.clear()
        accepted = asyncio.create_task(call(server, make_request(1)))
        await entered(fake)
        server.dataplane.refuse()
        error = await failure(call(server, make_request(1)))
        check(error, "UNAVAILABLE", 503, "UNAVAILABLE")
        assert error.retry_after == 1.0
        fake.free.set()
        assert await accepted


async def test_internal_tells_nothing(call: Call) -> None:
    fake = FakeForecaster()
    async with running(fake) as server:
        fake.broken = True
        error = await failure(call(server, make_request(1)))
        check(error, "INTERNAL", 500, "INTERNAL")
        assert "secret" not in str(error)
        fake.broken = False
        assert await call(server, make_request(1))


async def test_unexpected_exception_tells_nothing(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise KeyError("secret")

    async with running() as server:
        monkeypatch.setattr("service.predict.pipeline.make_plan", fail)
        error = await failure(call(server, make_request(1)))
        check(error, "INTERNAL", 500, "INTERNAL")
        assert "secret" not in str(error)


async def test_a_client_that_goes_away_leaves_the_queue(call: Call) -> None:
    fake = FakeForecaster()
    async with running(fake) as server:
        fake.free.clear()
        first = asyncio.create_task(call(server, make_request(1)))
        await entered(fake)
        gone = asyncio.create_task(call(server, make_request(3)))
        await until_waiting(server, 3)
        gone.cancel()
        with suppress(asyncio.CancelledError):
            await gone
        await until_waiting(server, 0)
        fake.free.set()
        await first
        assert [agents for _, agents, _, _ in fake.batches] == [1]


async def test_fallback_is_there(call: Call) -> None:
    async with running() as server:
        assert await call(server, make_request(1, model=FALLBACK_MODEL))
