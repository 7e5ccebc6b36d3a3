"""Consistency over REST."""

import asyncio
import functools
import json
from collections.abc import AsyncIterator
from typing import Any

import httpx
import pytest
from google.protobuf import json_format
from google.protobuf.message import Message

from cab.forecast.v1 import consistency_service_pb2 as pb
from service.errors import Overloaded, TrackingUnavailable
from service.server import Server
from tests.service.planes import AGENT, EVENT, MODELS, RESET, SCENE, FakePlane, with_fake_plane
from tests.service.servers import count, from_problem, running, until

PROTOBUF = "application/x-protobuf"
EVENTS = "/v1/consistency/events?scene_id=s"
BEGUN = 'data: {"instants":[],"missed":"0"}'
GETS: list[tuple[str, dict[str, Any], Message, Message]] = [
    (
        "/v1/consistency/agent",
        {"scene_id": "s & t", "agent_id": "ä", "window": 3.5},
        pb.GetAgentConsistencyRequest(scene_id="s & t", agent_id="ä", window=3.5),
        AGENT,
    ),
    (
        "/v1/consistency/agent",
        {"sceneId": "s"},
        pb.GetAgentConsistencyRequest(scene_id="s"),
        AGENT,
    ),
    ("/v1/consistency/scene", {"scene_id": "7"}, pb.GetSceneConsistencyRequest(scene_id="7"), SCENE),
    ("/v1/consistency/models", {}, pb.ListModelConsistencyRequest(), MODELS),
]


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    async with running() as made:
        yield made


@pytest.fixture
def plane(server: Server) -> FakePlane:
    return with_fake_plane(server)


@pytest.fixture
async def client(server: Server) -> AsyncIterator[httpx.AsyncClient]:
    async with httpx.AsyncClient(base_url=f"http://{server.http_address}", timeout=20) as made:
        yield made


@pytest.mark.parametrize(("path", "parameters", "asked", "answer"), GETS)
async def test_gets(
    plane: FakePlane,
    client: httpx.AsyncClient,
    path: str,
    parameters: dict[str, Any],
    asked: Message,
    answer: Message,
) -> None:
    response = await client.get(path, params=parameters)
    assert response.headers["content-type"] == "application/json"
    assert json_format.Parse(response.content, type(answer)()) == answer
    response = await client.get(path, params=parameters, headers={"accept": PROTOBUF})
    assert response.headers["content-type"] == PROTOBUF
    assert type(answer).FromString(response.content) == answer
    assert plane.asked == [asked, asked]
    refused = await client.get(path, params=parameters, headers={"accept": "text/html"})
    assert from_problem(refused).reason == "NOT_ACCEPTABLE"


@pytest.mark.parametrize(
    ("address", "field"),
    [
        ("/v1/consistency/agent?scene_id=s&agent_id=a&window=soon", "window"),
        ("/v1/consistency/agent?scene_id=s&agent_id=a&window=", "window"),
        ("/v1/consistency/agent?scene_id=s&agent_id=a&colour=red", "colour"),
        ("/v1/consistency/agent?scene_id=s&agent_id=a&scene_id=t", "scene_id"),
        ("/v1/consistency/scene?agent_id=a", "agent_id"),
        ("/v1/consistency/scene?", "scene_id"),
        ("/v1/consistency/scene?scene_id=", "scene_id"),
        (f"/v1/consistency/scene?scene_id={'s' * 129}", "scene_id"),
        ("/v1/consistency/agent?scene_id=s", "agent_id"),
        ("/v1/consistency/agent?scene_id=s&agent_id=a&window=99", "window"),
        ("/v1/consistency/agent?scene_id=s&agent_id=a&window=-1", "window"),
        ("/v1/consistency/agent?scene_id=s&agent_id=a&window=NaN", "window"),
        ("/v1/consistency/models?scene_id=s", "scene_id"),
        ("/v1/consistency/events", "scene_id"),
        ("/v1/consistency/events?scene_id=s&since=0", "since"),
    ],
)
async def test_bad_parameters_are_named(client: httpx.AsyncClient, address: str, field: str) -> None:
    """The server's own consistency service validates the values."""
    error = from_problem(await client.get(address))
    assert (error.http_status, error.reason) == (422, "BAD_FIELD")
    assert [name for name, _ in error.faults] == [field]


async def test_reset(plane: FakePlane, client: httpx.AsyncClient) -> None:
    asked = pb.ResetSceneRequest(scene_id="s")
    response = await client.post("/v1/consistency/reset", json={"scene_id": "s"})
    assert response.json() == {"agents": 7}
    response = await client.post(
        "/v1/consistency/reset", content=asked.SerializeToString(), headers={"content-type": PROTOBUF}
    )
    assert pb.ResetSceneResponse.FromString(response.content) == RESET
    assert plane.asked == [asked, asked]


@pytest.mark.parametrize(
    ("body", "content_type", "reason"),
    [
        (b"{", "application/json", "BAD_FIELD"),
        (b'{"scene": "s"}', "application/json", "BAD_FIELD"),
        (b'{"scene_id": 7}', "application/json", "BAD_FIELD"),
        (b"\xff\xff", PROTOBUF, "BAD_FIELD"),
        (b"scene_id=s", "application/x-www-form-urlencoded", "UNSUPPORTED_MEDIA_TYPE"),
        (b" " * 70_000, "application/json", "TOO_LARGE"),
    ],
)
async def test_resets_that_are_none(
    plane: FakePlane, client: httpx.AsyncClient, body: bytes, content_type: str, reason: str
) -> None:
    response = await client.post(
        "/v1/consistency/reset", content=body, headers={"content-type": content_type}
    )
    assert from_problem(response).reason == reason
    assert not plane.asked


class Reader:
    """Reader of Server-Sent Events as text."""

    def __init__(self, response: httpx.Response) -> None:
        self._chunks = response.aiter_text()
        self._text = ""

    async def read(self) -> str:
        """Return the next event or comment; "" at the end."""
        async with asyncio.timeout(10):
            while "\n\n" not in self._text:
                try:
                    self._text += await anext(self._chunks)
                except StopAsyncIteration:
                    assert not self._text
                    return ""
        event, _, self._text = self._text.partition("\n\n")
        return event


async def test_events(server: Server, plane: FakePlane, client: httpx.AsyncClient) -> None:
    async with client.stream("GET", EVENTS) as response:
        assert response.status_code == 200
        assert response.headers["content-type"] == "text/event-stream; charset=utf-8"
        assert response.headers["cache-control"] == "no-store"
        assert "content-length" not in response.headers
        reader = Reader(response)
        assert await reader.read() == BEGUN
        for _ in range(3):
            plane.send(EVENT)
            event = await reader.read()
            assert json_format.Parse(event.removeprefix("data: "), pb.WatchSceneResponse()) == EVENT
        await until(lambda: count(server, "rest", "WatchScene", "OK") == 0)
        plane.send(None)
        assert await reader.read() == ""
    assert plane.watching == 0
    await until(lambda: count(server, "rest", "WatchScene", "OK") == 1)


async def test_heartbeats(
    plane: FakePlane, client: httpx.AsyncClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.transports.rest.endpoints.HEARTBEAT", 0.1)
    async with client.stream("GET", EVENTS) as response:
        reader = Reader(response)
        assert [await reader.read() for _ in range(3)] == [BEGUN, ": heartbeat", ": heartbeat"]
        plane.send(EVENT)
        while (event := await reader.read()).startswith(":"):
            pass
        assert event.startswith("data: ")


async def test_a_client_that_goes_away_leaves_nothing(
    server: Server, plane: FakePlane, client: httpx.AsyncClient
) -> None:
    async with client.stream("GET", EVENTS), client.stream("GET", EVENTS) as response:
        assert await Reader(response).read() == BEGUN
        assert plane.watching == 2
    await until(lambda: plane.watching == 0)
    await until(lambda: count(server, "rest", "WatchScene", "CANCELLED") == 2)


async def test_a_client_that_does_not_read_leaves_nothing(server: Server, plane: FakePlane) -> None:
    _, writer = await asyncio.open_connection(*server.http_address.split(":"))
    writer.write(f"GET {EVENTS} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
    await until(lambda: plane.watching == 1)
    large = pb.WatchSceneResponse(instants=list(EVENT.instants) * 3000)
    for _ in range(20):  # more than sockets keep for it
        plane.send(large)
    await asyncio.sleep(0.2)
    writer.transport.abort()
    await until(lambda: plane.watching == 0)


async def test_a_client_that_goes_away_before_headers_leaves_nothing() -> None:
    async with running() as server:
        plane = with_fake_plane(server)
        plane.silent = True
        _, writer = await asyncio.open_connection(*server.http_address.split(":"))
        writer.write(f"GET {EVENTS} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        await until(lambda: plane.watching == 1)
        writer.close()
        await until(lambda: plane.watching == 0)


async def test_events_end_when_the_server_drains(
    server: Server, plane: FakePlane, client: httpx.AsyncClient
) -> None:
    async with client.stream("GET", EVENTS) as response:
        reader = Reader(response)
        assert await reader.read() == BEGUN
        async with asyncio.timeout(5):
            await server.stop()
        assert await reader.read() == ""
    await until(lambda: count(server, "rest", "WatchScene", "OK") == 1)


async def test_events_end_at_the_time_given(
    server: Server, plane: FakePlane, client: httpx.AsyncClient
) -> None:
    for plane.silent in (True, False):
        response = await client.get(EVENTS, headers={"Request-Timeout": "0.1"})
        assert response.status_code == 200
    await until(lambda: plane.watching == 0)
    await until(lambda: count(server, "rest", "WatchScene", "OK") == 2)
    refused = await client.get(EVENTS, headers={"Request-Timeout": "soon"})
    assert from_problem(refused).faults[0][0] == "Request-Timeout"


async def test_only_the_headers(plane: FakePlane, client: httpx.AsyncClient) -> None:
    response = await client.head(EVENTS)
    assert response.headers["content-type"].startswith("text/event-stream")
    await until(lambda: plane.watching == 0)


async def test_errors_before_the_first_event_are_problems(
    server: Server, plane: FakePlane, client: httpx.AsyncClient
) -> None:
    plane.error = Overloaded("too many watch", 2.0)
    error = from_problem(await client.get(EVENTS))
    assert (error.http_status, error.reason, error.retry_after) == (429, "OVERLOADED", 2.0)
    await until(lambda: count(server, "rest", "WatchScene", "RESOURCE_EXHAUSTED") == 1)
    refused = await client.get(EVENTS, headers={"accept": "application/json"})
    assert from_problem(refused).reason == "NOT_ACCEPTABLE"


async def test_errors_in_the_midst_are_events(
    server: Server, plane: FakePlane, client: httpx.AsyncClient
) -> None:
    for error, code, detail in (
        (TrackingUnavailable("it is gone"), "UNAVAILABLE", "it is gone"),
        (KeyError("secret"), "INTERNAL", "the server failed to answer; its log says why"),
    ):
        async with client.stream("GET", EVENTS) as response:
            reader = Reader(response)
            assert await reader.read() == BEGUN
            plane.send(error)
            kind, data = (await reader.read()).split("\n")
            assert kind == "event: error"
            problem = json.loads(data.removeprefix("data: "))
            assert (problem["code"], problem["detail"]) == (code, detail)
            assert await reader.read() == ""
        await until(functools.partial(count, server, "rest", "WatchScene", code))


async def test_all_need_a_token() -> None:
    async with running(api_tokens=("x",)) as server, httpx.AsyncClient() as client:
        plane = with_fake_plane(server)
        for path in ("agent", "scene", "models", "events"):
            refused = await client.get(f"http://{server.http_address}/v1/consistency/{path}")
            assert refused.headers["www-authenticate"] == "Bearer"
            assert from_problem(refused).http_status == 401
        refused = await client.post(f"http://{server.http_address}/v1/consistency/reset")
        assert from_problem(refused).http_status == 401
        assert not plane.asked
