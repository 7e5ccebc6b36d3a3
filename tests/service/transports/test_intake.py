"""Bounds of intake, with real servers and sockets: calls, bytes, connections and times."""

import asyncio
import functools
from collections.abc import AsyncIterator, Awaitable, Sequence
from contextlib import asynccontextmanager

import grpc
import httpx
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from cab.forecast.v1.routes import WATCH_SCENE
from service.server import Server
from service.settings import Settings
from service.transports.intake import SMALL_BODY
from service.transports.rest.connections import MAX_HEADER_BYTES
from tests.service.fakes import FakeForecaster
from tests.service.requests import make_request
from tests.service.servers import (
    PREDICT,
    TRANSPORTS,
    CallError,
    call_grpc,
    call_rest,
    count,
    running,
    until,
    until_waiting,
)

started = functools.partial(running, max_batch_agents=4)  # which shortens the warm-up
LARGE = SMALL_BODY + 1
Connection = tuple[asyncio.StreamReader, asyncio.StreamWriter]


def refused(server: Server, reason: str) -> float:
    """Return the number of refused calls."""
    return server.metrics.registry.get_sample_value("forecast_refused_total", {"reason": reason}) or 0.0


def watchers(server: Server) -> float:
    """Return the number of open streams of WatchScene."""
    return server.metrics.registry.get_sample_value("forecast_watchers", {"method": "WatchScene"}) or 0.0


@asynccontextmanager
async def connected(address: str, sent: Sequence[bytes]) -> AsyncIterator[list[Connection]]:
    """Open one connection for each of the given bytes, and send them."""
    host, port = address.rsplit(":", 1)
    connections = []
    try:
        for data in sent:
            connection = await asyncio.open_connection(host, int(port))
            connections.append(connection)
            connection[1].write(data)
        yield connections
    finally:
        for _, writer in connections:
            writer.transport.abort()


def post(length: int, *, body: bytes = b"") -> bytes:
    """Return the beginning of a Predict call over REST."""
    head = f"POST /v1/predict HTTP/1.1\r\nhost: x\r\ncontent-length: {length}\r\n"
    return head.encode() + b"content-type: application/x-protobuf\r\n\r\n" + body


def post_chunks(*chunks: bytes) -> bytes:
    """Return the beginning of a Predict call over REST with a body of unknown length."""
    head = b"POST /v1/predict HTTP/1.1\r\nhost: x\r\ntransfer-encoding: chunked\r\n\r\n"
    return head + b"".join(b"%x\r\n%b\r\n" % (len(chunk), chunk) for chunk in chunks)


def _frame(kind: int, flags: int, stream: int, payload: bytes = b"") -> bytes:
    return len(payload).to_bytes(3, "big") + bytes([kind, flags]) + stream.to_bytes(4, "big") + payload


def grpc_call(length: int, *, body: bytes = b"", method: str = PREDICT) -> bytes:
    """Return the beginning of a call over gRPC, as HTTP/2 frames."""
    headers = {
        ":method": "POST",
        ":scheme": "http",
        ":path": method,
        ":authority": "x",
        "te": "trailers",
        "content-type": "application/grpc",
    }
    encoded = b"".join(
        b"\0" + bytes([len(name)]) + name.encode() + bytes([len(value)]) + value.encode()
        for name, value in headers.items()
    )
    message = b"\0" + length.to_bytes(4, "big") + body
    settings, header_frame, data = _frame(4, 0, 0), _frame(1, 4, 1, encoded), _frame(0, 0, 1, message)
    return b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + settings + header_frame + data


async def status(connection: Connection) -> int:
    """Return the status of an HTTP response."""
    async with asyncio.timeout(10):
        return int((await connection[0].readline()).split()[1])


async def ended(connection: Connection) -> bool:
    """Wait until the server closes a connection."""
    async with asyncio.timeout(10):
        try:
            while await connection[0].read(2**16):
                pass
        except ConnectionError:
            pass
    return True


async def check_alive(server: Server) -> None:
    """Check that probes, metrics and health are answered."""
    async with httpx.AsyncClient(base_url=f"http://{server.http_address}", timeout=10) as client:
        for path in ("/livez", "/readyz", "/metrics"):
            assert (await client.get(path)).status_code == httpx.codes.OK
    async with grpc.aio.insecure_channel(server.grpc_address) as channel:
        answer = await health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=10)
        assert answer.status == health_pb2.HealthCheckResponse.SERVING


async def check_answers(server: Server) -> None:
    """Check that calls are answered on both transports."""
    for call in TRANSPORTS.values():
        assert len((await call(server, make_request(2))).forecasts) == 2
    await check_alive(server)


async def check_released(server: Server) -> None:
    """Check that no call is in progress, and that no bytes are reserved."""
    await until(lambda: (server.intake.calls, server.intake.bytes) == (0, 0))


async def overload(awaitable: Awaitable[object]) -> CallError:
    with pytest.raises(CallError) as caught:
        await awaitable
    assert (caught.value.code, caught.value.reason) == ("RESOURCE_EXHAUSTED", "OVERLOADED")
    assert caught.value.retry_after == 1.0
    return caught.value


async def test_calls_on_both_transports_share_a_bound() -> None:
    fake = FakeForecaster()
    async with started(fake, max_concurrent_calls=2) as server:
        fake.free.clear()
        accepted = [asyncio.create_task(call(server, make_request())) for call in TRANSPORTS.values()]
        await until(lambda: server.intake.calls == 2)
        for call in TRANSPORTS.values():
            await overload(call(server, b"no message: the body is never read"))
        assert refused(server, "concurrency") == 2
        assert count(server, "grpc", "Predict", "RESOURCE_EXHAUSTED") == 1
        assert count(server, "rest", "Predict", "RESOURCE_EXHAUSTED") == 1
        await check_alive(server)
        fake.free.set()
        await asyncio.gather(*accepted)
        await check_answers(server)
        await check_released(server)


async def test_streams_have_a_bound_of_their_own() -> None:
    path = "/cab.forecast.v1.ConsistencyService/WatchScene"
    watch = f"GET {WATCH_SCENE.path}?scene_id=s HTTP/1.1\r\nhost: x\r\n\r\n".encode()
    async with started(max_concurrent_calls=1, max_watchers=2) as server:
        call = grpc_call(3, body=b"\x0a\x01s", method=path)
        async with connected(server.grpc_address, [call]), connected(server.http_address, [watch]):
            await until(lambda: watchers(server) == 2)
            await check_answers(server)
            async with connected(server.http_address, [watch]) as [third]:
                assert await status(third) == 429
        assert refused(server, "watchers") == 1
        assert refused(server, "concurrency") == 0
        await until(lambda: watchers(server) == 0)


async def test_bodies_of_known_length_are_counted_before_they_arrive() -> None:
    async with started(max_request_bytes=LARGE, max_intake_bytes=4 * LARGE) as server:
        async with connected(server.http_address, [post(LARGE)] * 12) as uploads:
            await until(lambda: refused(server, "bytes") == 9)
            assert server.intake.bytes == 3 * LARGE  # the last quarter is for small bodies
            await check_answers(server)
            assert [await status(upload) for upload in uploads[3:]] == [429] * 9
        await check_released(server)


async def test_bodies_of_unknown_length_are_counted_as_they_arrive() -> None:
    async with started(max_request_bytes=LARGE, max_intake_bytes=2 * LARGE) as server:
        half = bytes(LARGE // 2 - 1)
        async with connected(server.http_address, [post_chunks(half)] * 2):
            await until(lambda: server.intake.bytes == 2 * len(half))
            async with connected(server.http_address, [post_chunks(half), post_chunks(half)]) as uploads:
                await until(lambda: server.intake.bytes == 4 * len(half))
                assert refused(server, "bytes") == 0
                uploads[0][1].write(b"8\r\n12345678\r\n")
                assert await status(uploads[0]) == 429
                assert refused(server, "bytes") == 1
        await check_released(server)
        await check_answers(server)


async def test_slow_bodies_end() -> None:
    async with started(body_timeout=0.3) as server:
        async with connected(server.http_address, [post(1000, body=b"1"), post_chunks(b"1")]) as uploads:
            assert [await status(upload) for upload in uploads] == [408, 408]
            assert count(server, "rest", "Predict", "DEADLINE_EXCEEDED") == 2
            await check_released(server)
            for upload in uploads:  # which never ends its body
                assert await ended(upload)
        async with connected(server.grpc_address, [grpc_call(1000, body=b"1")]):
            await until(lambda: count(server, "grpc", "Predict", "DEADLINE_EXCEEDED") == 1)
        await check_released(server)
        await check_answers(server)


async def test_slow_bodies_over_grpc_count_as_the_largest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.transports.grpc.intake.SLOW_SECONDS", 0.1)
    async with started(max_request_bytes=LARGE, max_intake_bytes=8 * LARGE, body_timeout=20) as server:
        uploads = [grpc_call(LARGE, body=bytes(1000))] * 10
        async with connected(server.grpc_address, uploads):
            await until(lambda: refused(server, "bytes") == 7)
            await until(lambda: server.intake.calls == 3)
            assert server.intake.bytes == 6 * LARGE
            assert count(server, "grpc", "Predict", "RESOURCE_EXHAUSTED") == 7
            await check_answers(server)
        await check_released(server)  # clients that go away leave nothing behind


async def test_a_body_over_grpc_counts_once_it_arrived() -> None:
    fake = FakeForecaster()
    async with started(fake, max_request_bytes=2**16, max_intake_bytes=2**17) as server:
        fake.free.clear()
        unknown_field = b"\xfa\x7f\xc0\xb8\x02" + bytes(40_000)
        request = make_request().SerializeToString() + unknown_field
        accepted = [asyncio.create_task(call_grpc(server, request)) for _ in range(3)]
        await until(lambda: server.intake.bytes == 3 * len(request))
        for call in (call_grpc, call_rest):
            await overload(call(server, request))
        assert refused(server, "bytes") == 2
        fake.free.set()
        assert [len(answer.forecasts) for answer in await asyncio.gather(*accepted)] == [1] * 3
        await check_released(server)


async def test_half_headers_end() -> None:
    async with started(header_timeout=0.3) as server:
        half = b"GET /livez HTTP/1.1\r\nhost:"
        async with connected(server.http_address, [half, b"", *[half] * 50]) as connections:
            assert await status(connections[0]) == 408
            assert await status(connections[1]) == 408
            for connection in connections:
                assert await ended(connection)
        # The time does not run between requests, and begins anew with each.
        async with connected(server.http_address, [half + b"x\r\n\r\n"]) as [connection]:
            assert await status(connection) == 200
            await asyncio.sleep(0.5)
            connection[1].write(half + b"x\r\n\r\n")
            assert await connection[0].readuntil(b"HTTP/1.1 200 ")
            connection[1].write(half)
            assert await connection[0].readuntil(b"HTTP/1.1 408 ")


async def test_half_headers_do_not_keep_others_out() -> None:
    async with started(max_concurrent_calls=4, max_watchers=1, header_timeout=60) as server:
        half = b"GET /livez HTTP/1.1\r\nhost:"
        async with connected(server.http_address, [half] * 40) as connections:
            await check_answers(server)
            # At most ten are open; the calls above closed the oldest of these
            closed = [each for each in connections if each[0].at_eof() or each[0].exception() is not None]
            assert len(closed) >= 30
            assert closed == connections[: len(closed)]
            assert len(closed) < 40


async def test_headers_have_a_limit() -> None:
    async with started() as server:
        line = b"x: " + bytes(b"y" * 1000) + b"\r\n"
        first = b"GET /livez HTTP/1.1\r\nhost: x\r\n"
        lines = line * (MAX_HEADER_BYTES // len(line) + 1)
        async with connected(server.http_address, [first + lines]) as [connection]:
            assert await status(connection) == 431
        async with connected(server.http_address, [first + line * 32 + b"\r\n"]) as [connection]:
            assert await status(connection) == 200


def test_a_full_request_fits_into_the_budget() -> None:
    with pytest.raises(ValueError, match="max_intake_bytes must be at least 4/3 of max_request_bytes"):
        Settings(max_request_bytes=3 * 2**20, max_intake_bytes=4 * 2**20 - 4)
    assert (
        Settings(max_request_bytes=3 * 2**20, max_intake_bytes=4 * 2**20).max_large_intake_bytes == 3 * 2**20
    )


async def test_a_call_over_grpc_is_refused_before_its_request_is_read() -> None:
    fake = FakeForecaster()
    async with started(fake, workers=0, max_agents=4, max_queue_agents=4) as server:
        fake.free.clear()
        accepted = [asyncio.create_task(call_grpc(server, make_request(4)))]
        await until(fake.entered.is_set)
        for _ in range(2):  # one that the thread of the forward is given ahead, and one that fills the queue
            accepted.append(asyncio.create_task(call_grpc(server, make_request(4))))
            await asyncio.sleep(0.3)
        await until_waiting(server, 4)
        async with connected(server.grpc_address, [grpc_call(1000, body=b"the rest never comes")]):
            await until(lambda: count(server, "grpc", "Predict", "RESOURCE_EXHAUSTED") == 1)
        assert refused(server, "queue_full") == 1
        fake.free.set()
        await asyncio.gather(*accepted)
        await check_released(server)


async def test_responses_that_are_not_read_give_their_places_free() -> None:
    async with started(write_timeout=0.3, max_concurrent_calls=4) as server:
        request = make_request(20)
        request.options.samples = 2000  # more than the buffers of a connection hold
        body = request.SerializeToString()
        unread = [grpc_call(len(body), body=body)] * 2
        async with connected(server.http_address, [post(len(body), body=body)] * 2) as connections:
            async with connected(server.grpc_address, unread):
                await until(lambda: count(server, "rest", "Predict", "OK") == 2)
                await until(lambda: count(server, "grpc", "Predict", "OK") == 2)
                await check_released(server)
                await check_answers(server)
            for connection in connections:
                assert await ended(connection)
