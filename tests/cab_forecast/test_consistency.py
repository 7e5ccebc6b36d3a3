"""Consistency calls of the client, to the real server with a scripted consistency service."""

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from pydantic import SecretStr

from cab.forecast.v1 import consistency_service_pb2 as pb
from cab_forecast import (
    AsyncClient,
    Client,
    DeadlineExceeded,
    InternalError,
    NotFound,
    Overloaded,
    TrackingUnavailable,
    Unauthenticated,
    Unavailable,
    UnknownTrack,
)
from service import errors
from service.server import Server
from tests.cab_forecast.fakes import Raw, Script, free_port, http_fake, raw_server
from tests.service.planes import AGENT, EVENT, MODELS, RESET, SCENE, FakePlane, with_fake_plane
from tests.service.servers import in_thread, settings, until

TOKEN = "a-token"  # noqa: S105
Call = Callable[..., Any]
SSE_HEAD = b"HTTP/1.1 200 OK\r\ncontent-type: text/event-stream\r\ntransfer-encoding: chunked\r\n\r\n"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Run a server with the baselines."""
    models = tmp_path_factory.mktemp("models")
    with in_thread(settings(models=models, api_tokens=(SecretStr(TOKEN),))) as running:
        yield running


@pytest.fixture
def plane(server: Server) -> FakePlane:
    return with_fake_plane(server)


@pytest.fixture(params=["grpc", "http", "http-json"])
def arguments(request: pytest.FixtureRequest, server: Server) -> dict[str, Any]:
    """Return the arguments of a client for that server."""
    if request.param == "grpc":
        return {"endpoint": f"grpc://{server.grpc_address}", "token": TOKEN}
    encoding = "json" if request.param == "http-json" else "protobuf"
    return {"endpoint": f"http://{server.http_address}", "token": TOKEN, "encoding": encoding}


@pytest.fixture
def ask(call_at: Call, arguments: dict[str, Any]) -> Call:
    """``ask(method, …)`` with a client of either kind."""
    endpoint = arguments["endpoint"]
    others = {name: value for name, value in arguments.items() if name != "endpoint"}
    return lambda *args, **kwargs: call_at(endpoint, others, *args, **kwargs)


def test_calls(ask: Call, plane: FakePlane) -> None:
    assert ask("agent_consistency", "s", "ä & b") == list(AGENT.instants)
    assert ask("agent_consistency", "s", "a", window=3.5) == list(AGENT.instants)
    assert ask("scene_consistency", "s") == SCENE
    assert ask("model_consistency") == list(MODELS.models)
    assert ask("reset_scene", "s") == RESET.agents
    assert plane.asked == [
        pb.GetAgentConsistencyRequest(scene_id="s", agent_id="ä & b"),
        pb.GetAgentConsistencyRequest(scene_id="s", agent_id="a", window=3.5),
        pb.GetSceneConsistencyRequest(scene_id="s"),
        pb.ListModelConsistencyRequest(),
        pb.ResetSceneRequest(scene_id="s"),
    ]


def test_unknown_tracks(ask: Call, plane: FakePlane) -> None:
    plane.error = errors.UnknownTrack("nothing is remembered")
    with pytest.raises(UnknownTrack, match="nothing is remembered") as caught:
        ask("scene_consistency", "s")
    assert isinstance(caught.value, NotFound)
    assert len(plane.asked) == 1


def test_a_track_memory_that_does_not_answer_is_asked_again(ask: Call, plane: FakePlane) -> None:
    plane.error = errors.TrackingUnavailable("no answer", 0.01)
    with pytest.raises(TrackingUnavailable, match="no answer") as caught:
        ask("scene_consistency", "s")
    assert isinstance(caught.value, Unavailable)
    assert len(plane.asked) == 3


def test_watching(arguments: dict[str, Any], plane: FakePlane) -> None:
    with Client(**arguments) as client:
        with client.watch_scene("s") as events:
            assert plane.asked == [pb.WatchSceneRequest(scene_id="s")]
            assert plane.watching == 1  # it has begun when the call returns
            for _ in range(3):
                plane.send(EVENT)
                assert next(events) == EVENT
        assert list(events) == []
        plane.wait(0)


def test_the_server_ends_a_watch(arguments: dict[str, Any], plane: FakePlane) -> None:
    with Client(**arguments) as client:
        events = client.watch_scene("s")
        plane.send(EVENT)
        plane.send(None)
        assert list(events) == [EVENT]
        assert list(events) == []
        plane.wait(0)


def test_a_watch_that_fails(arguments: dict[str, Any], plane: FakePlane) -> None:
    with Client(**arguments) as client, client.watch_scene("s") as events:
        plane.send(EVENT)
        plane.send(errors.TrackingUnavailable("it is gone"))
        assert next(events) == EVENT
        with pytest.raises(TrackingUnavailable, match="it is gone"):
            next(events)
        assert list(events) == []
        assert len(plane.asked) == 1  # whoever watches decides whether to go on, with events missed


def test_a_watch_that_does_not_begin_is_tried_again(arguments: dict[str, Any], plane: FakePlane) -> None:
    plane.error = errors.Overloaded("too many watch", 0.01)
    with Client(**arguments) as client, pytest.raises(Overloaded, match="too many"):
        client.watch_scene("s")
    assert len(plane.asked) == 3
    with Client(**arguments | {"token": "guess"}) as client, pytest.raises(Unauthenticated):
        client.watch_scene("s")


def test_closing_wakes_whoever_waits(arguments: dict[str, Any], plane: FakePlane) -> None:
    with Client(**arguments) as client:
        events = client.watch_scene("s")
        found: list[list[pb.WatchSceneResponse]] = []
        reader = threading.Thread(target=lambda: found.append(list(events)))
        reader.start()
        time.sleep(0.1)
        events.close()
        reader.join(5)
        assert found == [[]]
        events.close()
        plane.wait(0)


async def test_watching_with_asyncio(arguments: dict[str, Any], plane: FakePlane) -> None:
    async with AsyncClient(**arguments) as client:
        async with client.watch_scene("s") as events:
            assert plane.watching == 1
            plane.send(EVENT)
            assert await anext(events) == EVENT
        assert [event async for event in events] == []
        await until(lambda: plane.watching == 0)
        unopened = client.watch_scene("s")
        asyncio.get_running_loop().call_later(0.3, plane.send, EVENT)
        async for event in unopened:  # without "async with" it begins here
            assert event == EVENT
            plane.send(None)
        await until(lambda: plane.watching == 0)


async def test_a_watch_that_fails_with_asyncio(arguments: dict[str, Any], plane: FakePlane) -> None:
    async with AsyncClient(**arguments) as client:
        async with client.watch_scene("s") as events:
            plane.send(errors.TrackingUnavailable("it is gone"))
            with pytest.raises(TrackingUnavailable, match="it is gone"):
                await anext(events)
        plane.error = errors.Overloaded("too many watch", 0.01)
        with pytest.raises(Overloaded):
            await anext(client.watch_scene("s"))
        assert len(plane.asked) == 4


async def test_closing_wakes_the_task_that_waits(arguments: dict[str, Any], plane: FakePlane) -> None:
    async with AsyncClient(**arguments) as client, client.watch_scene("s") as events:

        async def read() -> list[pb.WatchSceneResponse]:
            return [event async for event in events]

        reading = asyncio.create_task(read())
        await asyncio.sleep(0.1)
        await events.aclose()
        async with asyncio.timeout(5):
            assert await reading == []
        await until(lambda: plane.watching == 0)


async def test_a_task_that_is_cancelled_ends_its_watch(arguments: dict[str, Any], plane: FakePlane) -> None:
    async with AsyncClient(**arguments) as client:
        events = client.watch_scene("s")
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(anext(events), 0.5)
        await until(lambda: plane.watching == 0)
        assert [event async for event in events] == []


async def test_a_closed_client_ends_its_watches(server: Server, plane: FakePlane) -> None:
    client = AsyncClient(f"grpc://{server.grpc_address}", token=TOKEN)
    async with client.watch_scene("s") as events:
        reading = asyncio.ensure_future(anext(events))
        await asyncio.sleep(0.1)
        await client.close()
        with pytest.raises(Unavailable):
            await reading
    await until(lambda: plane.watching == 0)
    with pytest.raises(RuntimeError, match="closed"):
        await anext(client.watch_scene("s"))


def test_a_watch_that_begins_too_late(arguments: dict[str, Any], plane: FakePlane) -> None:
    plane.silent = True
    start = time.monotonic()
    with Client(**arguments) as client, pytest.raises(DeadlineExceeded, match=r"0\.4 s"):
        client.watch_scene("s", timeout=0.4)
    assert 0.3 < time.monotonic() - start < 5
    plane.wait(0)


async def test_a_watch_that_begins_too_late_with_asyncio(arguments: dict[str, Any], plane: FakePlane) -> None:
    plane.silent = True
    async with AsyncClient(**arguments) as client:
        with pytest.raises(DeadlineExceeded, match=r"0\.4 s"):
            await anext(client.watch_scene("s", timeout=0.4))
    await until(lambda: plane.watching == 0)


def test_servers_that_do_not_say_that_it_begins(arguments: dict[str, Any], plane: FakePlane) -> None:
    plane.silent = True
    threading.Timer(0.2, plane.send, [EVENT]).start()
    with Client(**arguments) as client, client.watch_scene("s") as events:
        assert next(events) == EVENT


async def test_servers_that_do_not_say_that_it_begins_with_asyncio(
    arguments: dict[str, Any], plane: FakePlane
) -> None:
    plane.silent = True
    asyncio.get_running_loop().call_later(0.2, plane.send, EVENT)
    async with AsyncClient(**arguments) as client, client.watch_scene("s") as events:
        assert await anext(events) == EVENT


@pytest.mark.parametrize("scheme", ["grpc", "http"])
def test_nobody_there_to_watch(scheme: str) -> None:
    endpoint = f"{scheme}://127.0.0.1:{free_port()}"
    with Client(endpoint) as client, pytest.raises(Unavailable, match=endpoint) as caught:
        client.watch_scene("s")
    assert caught.value.reason == "UNREACHABLE"


@pytest.mark.parametrize(
    ("drip", "match"),
    [(None, "lost the connection"), (b"", r"no data for 0\.3 s")],
    ids=["broken", "silent"],
)
def test_a_watch_that_breaks_off(monkeypatch: pytest.MonkeyPatch, drip: bytes | None, match: str) -> None:
    monkeypatch.setattr("cab_forecast.rest_transport.IDLE_TIMEOUT", 0.3)
    head = SSE_HEAD + b'15\r\ndata: {"missed": 1}\n\n\r\n'
    with raw_server(head, drip) as address, Client(f"http://{address}") as client:
        events = client.watch_scene("s", timeout=5)
        assert next(events) == pb.WatchSceneResponse(missed=1)
        with pytest.raises(Unavailable, match=match) as caught:
            next(events)
    assert caught.value.reason == "UNREACHABLE"


def test_what_is_no_stream(script: Script) -> None:
    script.failures = [Raw(200, b"<html>", {"content-type": "text/html"})]
    with (
        http_fake(script) as address,
        Client(f"http://{address}") as client,
        pytest.raises(InternalError, match="instead of text/event-stream"),
    ):
        client.watch_scene("s")
