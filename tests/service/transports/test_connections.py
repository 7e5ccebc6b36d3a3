"""Connections as clients, proxies and load balancers keep them, with real servers and sockets."""

import asyncio
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import grpc
import httpx
import pytest

from cab.forecast.v1 import consistency_service_pb2 as pb
from cab.forecast.v1.consistency_service_pb2_grpc import ConsistencyServiceStub
from cab.forecast.v1.model_service_pb2 import ListModelsRequest
from cab.forecast.v1.model_service_pb2_grpc import ModelServiceStub
from service.settings import Settings
from service.transports.grpc.server import MIN_PING_INTERVAL
from tests.service.planes import EVENT, with_fake_plane
from tests.service.servers import running, until

WATCH = pb.WatchSceneRequest(scene_id="s")
BEGUN = pb.WatchSceneResponse()
_SETTINGS, _PING, _GOAWAY = 4, 6, 7
"""Types of HTTP/2 frames, RFC 9113 section 6."""
_ESTABLISHED = "01"
"""State in the kernel's table of TCP connections."""


def frame(kind: int, payload: bytes = b"") -> bytes:
    """Return an HTTP/2 frame of the connection as a whole."""
    return struct.pack(">I", len(payload))[1:] + bytes([kind, 0]) + bytes(4) + payload


async def may_ping(address: str, pings: int, interval: float) -> bool:
    """Send pings on an HTTP/2 connection without calls; return whether each was answered."""
    host, _, port = address.rpartition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + frame(_SETTINGS))
    try:
        async with asyncio.timeout(10):
            for _ in range(pings):
                writer.write(frame(_PING, bytes(8)))
                kind = None
                while kind != _PING:
                    head = await reader.readexactly(9)
                    await reader.readexactly(int.from_bytes(head[:3], "big"))
                    kind = head[3]
                    if kind == _GOAWAY:
                        return False
                await asyncio.sleep(interval)
    finally:
        writer.transport.abort()
    return True


async def test_a_client_without_calls_may_ping(monkeypatch: pytest.MonkeyPatch) -> None:
    async with running() as server:
        assert not await may_ping(server.grpc_address, 8, 0.1)
    monkeypatch.setattr("service.transports.grpc.server.MIN_PING_INTERVAL", 0.05)
    async with running() as server:
        assert await may_ping(server.grpc_address, 8, 0.1)


def test_pings_every_ten_seconds_are_never_too_early() -> None:
    assert MIN_PING_INTERVAL <= 10 / 2, "no room for a late ping that the next one follows on time"


async def test_over_grpc_a_client_gets_a_new_connection_after_a_while_and_loses_no_call() -> None:
    async with running(max_connection_age=0.2) as server:
        with_fake_plane(server)
        async with grpc.aio.insecure_channel(server.grpc_address) as channel:
            watch = ConsistencyServiceStub(channel).WatchScene(WATCH)
            assert await watch.read() == BEGUN
            stub = ModelServiceStub(channel)
            most = 0  # at any one moment the newer connection may be between two
            for _ in range(120):
                assert (await stub.ListModels(ListModelsRequest())).models
                most = max(most, established(server.grpc_address))
                await asyncio.sleep(0.01)
            assert most >= 2, "the watch's connection and a newer one"
            watch.cancel()


async def test_over_rest_a_client_is_asked_for_a_new_connection_after_a_while() -> None:
    async with (
        running(max_connection_age=0.2) as server,
        httpx.AsyncClient(base_url=f"http://{server.http_address}") as client,
    ):
        asked = []
        for _ in range(60):
            response = await client.get("/livez")
            assert response.status_code == httpx.codes.OK
            asked.append(response.headers.get("connection") == "close")
            await asyncio.sleep(0.01)
        assert not asked[0]
        assert 1 <= sum(asked) < len(asked) / 2


def test_idle_connections_outlive_those_of_proxies() -> None:
    assert Settings().idle_timeout == 75.0


@pytest.mark.parametrize(("idle", "kept"), [(0.1, False), (20.0, True)])
async def test_an_idle_connection_is_kept_as_long_as_the_setting_says(idle: float, kept: bool) -> None:
    async with running(idle_timeout=idle) as server:
        host, _, port = server.http_address.rpartition(":")
        reader, writer = await asyncio.open_connection(host, int(port))
        for _ in range(2):
            writer.write(b"GET /livez HTTP/1.1\r\nhost: x\r\n\r\n")
            await reader.readuntil(b"alive\n")
            try:
                async with asyncio.timeout(0.6):
                    ended = await reader.read() == b""
            except TimeoutError:
                ended = False
            assert ended != kept
            if ended:
                break
        writer.transport.abort()


async def test_a_quiet_stream_has_heartbeats_over_grpc(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.transports.grpc.handlers.HEARTBEAT", 0.05)
    async with running() as server:
        plane = with_fake_plane(server)
        async with grpc.aio.insecure_channel(server.grpc_address) as channel:
            call = ConsistencyServiceStub(channel).WatchScene(WATCH)
            assert [await call.read() for _ in range(4)] == [BEGUN] * 4
            plane.send(EVENT)
            while (message := await call.read()) == BEGUN:
                pass
            assert message == EVENT
            call.cancel()


@asynccontextmanager
async def watching_over_rest(client: httpx.AsyncClient) -> AsyncIterator[None]:
    """Watch a scene until the first event has arrived."""
    async with client.stream("GET", "/v1/consistency/events", params={"scene_id": "s"}) as response:
        assert response.status_code == httpx.codes.OK, await response.aread()
        await anext(response.aiter_bytes())
        yield


async def test_streams_that_clients_cancel_leave_nothing() -> None:
    """Open and cancel hundreds of streams on both transports, before and after their first message."""
    async with (
        running() as server,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
        httpx.AsyncClient(base_url=f"http://{server.http_address}", timeout=20) as client,
    ):
        plane = with_fake_plane(server)
        stub = ConsistencyServiceStub(channel)

        async def one(number: int) -> None:
            if number % 4 == 3:
                async with watching_over_rest(client):
                    return
            call = stub.WatchScene(WATCH)
            if number % 4:
                assert await call.read() == BEGUN
            call.cancel()

        async def many(count: int) -> tuple[int, int]:
            for start in range(0, count, 40):
                await asyncio.gather(*(one(start + number) for number in range(40)))
            await until(lambda: plane.watching == 0)
            await asyncio.sleep(0.2)
            return len(asyncio.all_tasks()), open_files()

        tasks, files = await many(80)
        after = await many(400)
        assert after[0] <= tasks + 5
        assert after[1] <= files + 5


def open_files() -> int:
    """Return the number of files and sockets that this process has open."""
    return len(list(Path("/proc/self/fd").iterdir()))


def established(address: str) -> int:
    """Return the number of connections that a server has accepted, by the kernel's tables."""
    port = f":{int(address.rpartition(':')[2]):04X}"
    rows = [
        row.split()
        for table in ("tcp", "tcp6")
        for row in (Path("/proc/net") / table).read_text(encoding="ascii").splitlines()
    ]
    return sum(row[1].endswith(port) and row[3] == _ESTABLISHED for row in rows)
