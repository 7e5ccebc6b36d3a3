"""ConsistencyService over gRPC."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import grpc
import pytest

from cab.forecast.v1 import consistency_service_pb2 as pb
from cab.forecast.v1.consistency_service_pb2_grpc import ConsistencyServiceStub
from service.errors import Overloaded, TrackingUnavailable
from service.server import Server
from tests.service.planes import AGENT, EVENT, MODELS, RESET, SCENE, FakePlane, with_fake_plane
from tests.service.servers import CallError, count, from_grpc, running, until

TOKEN = (("authorization", "Bearer token"),)
WATCH = pb.WatchSceneRequest(scene_id="s")
BEGUN = pb.WatchSceneResponse()


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    async with running(api_tokens=("token",)) as made:
        yield made


@pytest.fixture
def plane(server: Server) -> FakePlane:
    return with_fake_plane(server)


@pytest.fixture
async def stub(server: Server) -> AsyncIterator[Any]:
    async with grpc.aio.insecure_channel(server.grpc_address) as channel:
        yield ConsistencyServiceStub(channel)


async def failure(call: Any) -> CallError:
    """Return the error that a stream ends with."""
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        [_ async for _ in call]
    return from_grpc(caught.value)


@pytest.mark.parametrize(
    ("method", "request_", "answer"),
    [
        ("GetAgentConsistency", pb.GetAgentConsistencyRequest(scene_id="s", agent_id="a", window=3), AGENT),
        ("GetSceneConsistency", pb.GetSceneConsistencyRequest(scene_id="s"), SCENE),
        ("ListModelConsistency", pb.ListModelConsistencyRequest(), MODELS),
        ("ResetScene", pb.ResetSceneRequest(scene_id="s"), RESET),
    ],
)
async def test_calls(
    server: Server, plane: FakePlane, stub: Any, method: str, request_: Any, answer: Any
) -> None:
    assert await getattr(stub, method)(request_, metadata=TOKEN) == answer
    assert plane.asked == [request_]
    await until(lambda: count(server, "grpc", method, "OK") == 1)
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        await getattr(stub, method)(request_)
    assert from_grpc(caught.value).reason == "UNAUTHENTICATED"


async def test_watch_gives_events_as_they_come(server: Server, plane: FakePlane, stub: Any) -> None:
    call = stub.WatchScene(WATCH, metadata=TOKEN)
    events = aiter(call)
    assert await anext(events) == BEGUN
    assert plane.asked == [WATCH]
    for _ in range(3):
        plane.send(EVENT)
        assert await anext(events) == EVENT
    plane.send(None)
    assert [event async for event in events] == []
    assert await call.code() is grpc.StatusCode.OK
    await until(lambda: count(server, "grpc", "WatchScene", "OK") == 1)
    assert plane.watching == 0


async def test_a_client_that_ends_a_watch_leaves_nothing(server: Server, plane: FakePlane, stub: Any) -> None:
    calls = [stub.WatchScene(WATCH, metadata=TOKEN) for _ in range(3)]
    await until(lambda: plane.watching == 3)
    assert await calls[1].read() == BEGUN
    for call in calls:
        call.cancel()
    await until(lambda: plane.watching == 0)
    await until(lambda: count(server, "grpc", "WatchScene", "CANCELLED") == 3)


async def test_a_client_that_does_not_read_leaves_nothing(
    server: Server, plane: FakePlane, stub: Any
) -> None:
    call = stub.WatchScene(WATCH, metadata=TOKEN)
    await until(lambda: plane.watching == 1)
    large = pb.WatchSceneResponse(instants=list(EVENT.instants) * 3000)
    for _ in range(20):  # more than gRPC keeps for it
        plane.send(large)
    await asyncio.sleep(0.2)
    call.cancel()
    await until(lambda: plane.watching == 0)


async def test_a_watch_ends_with_its_deadline(plane: FakePlane, stub: Any) -> None:
    error = await failure(stub.WatchScene(WATCH, metadata=TOKEN, timeout=0.3))
    assert error.code == "DEADLINE_EXCEEDED"
    await until(lambda: plane.watching == 0)


async def test_a_watch_ends_well_when_the_server_drains(server: Server, plane: FakePlane, stub: Any) -> None:
    call = stub.WatchScene(WATCH, metadata=TOKEN)
    await until(lambda: plane.watching == 1)
    async with asyncio.timeout(5):
        await server.stop()
    assert [event async for event in call] == [BEGUN]
    assert await call.code() is grpc.StatusCode.OK
    await until(lambda: count(server, "grpc", "WatchScene", "OK") == 1)


async def test_errors_of_a_watch_have_details(server: Server, plane: FakePlane, stub: Any) -> None:
    plane.error = Overloaded("too many watch", 2.0)
    error = await failure(stub.WatchScene(WATCH, metadata=TOKEN))
    assert (error.code, error.reason, error.retry_after) == ("RESOURCE_EXHAUSTED", "OVERLOADED", 2.0)
    await until(lambda: count(server, "grpc", "WatchScene", "RESOURCE_EXHAUSTED") == 1)


async def test_errors_in_the_midst_of_a_watch(server: Server, plane: FakePlane, stub: Any) -> None:
    call = stub.WatchScene(WATCH, metadata=TOKEN)
    await until(lambda: plane.watching == 1)
    plane.send(EVENT)
    plane.send(TrackingUnavailable("it is gone"))
    events = aiter(call)
    assert [await anext(events), await anext(events)] == [BEGUN, EVENT]
    error = await failure(events)
    assert (error.code, error.message, error.reason) == ("UNAVAILABLE", "it is gone", "TRACKING_UNAVAILABLE")
    await until(lambda: count(server, "grpc", "WatchScene", "UNAVAILABLE") == 1)
    call = stub.WatchScene(WATCH, metadata=TOKEN)
    await until(lambda: plane.watching == 1)
    plane.send(KeyError("secret"))
    error = await failure(call)
    assert (error.code, error.reason) == ("INTERNAL", "INTERNAL")
    assert "secret" not in str(error)


async def test_a_watch_needs_a_token_and_a_message(server: Server, plane: FakePlane, stub: Any) -> None:
    assert (await failure(stub.WatchScene(WATCH))).reason == "UNAUTHENTICATED"
    await until(lambda: count(server, "grpc", "WatchScene", "UNAUTHENTICATED") == 1)
    async with grpc.aio.insecure_channel(server.grpc_address) as channel:
        watch = channel.unary_stream("/cab.forecast.v1.ConsistencyService/WatchScene", None, None)
        assert (await failure(watch(b"\xff\xff", metadata=TOKEN))).faults[0][0] == "body"
    assert not plane.asked
