"""The server's life: starting, failing to start, draining, as a process of its own."""

import asyncio
import shutil
import signal
import socket
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from unittest.mock import Mock

import grpc
import httpx
import psutil
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from structlog.testing import capture_logs

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab_forecast import AsyncClient, Client, UnknownTrack
from model.registry import Registry
from service.lifecycle import Phase
from service.server import ServeError, Server, StartError
from service.settings import Settings
from tests.model.checkpoints import copy_bundled
from tests.service.fakes import FakeForecaster, registry
from tests.service.processes import process, ready
from tests.service.requests import make_request
from tests.service.servers import (
    PREDICT,
    TRANSPORTS,
    CallError,
    call_grpc,
    call_rest,
    running,
    settings,
    until_waiting,
)


@contextmanager
def taken_port() -> Iterator[str]:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield f"127.0.0.1:{taken.getsockname()[1]}"


@pytest.mark.parametrize("name", ["http", "grpc"])
async def test_a_taken_port(name: str) -> None:
    with taken_port() as address:
        server = Server(settings(**{name: address}))
        with pytest.raises(StartError, match=f"{name}: cannot listen on {address}"):
            await server.start()


async def test_a_missing_model() -> None:
    with pytest.raises(StartError, match="default_model: there is no model 'nobody'"):
        await Server(settings(default_model="nobody")).start()


async def test_missing_and_broken_checkpoints(tmp_path: Path) -> None:
    with pytest.raises(StartError, match="no such folder"):
        await Server(settings(models=tmp_path / "nowhere")).start()
    copy_bundled(tmp_path / "cab")
    (tmp_path / "cab" / "model.safetensors").write_bytes(b"")
    with pytest.raises(
        StartError, match=r"cab is not loaded, and a checkpoint was refused: cab: .*safetensors"
    ):
        await Server(settings(models=tmp_path)).start()
    with pytest.raises(StartError, match=r"no model 'cab'.*refused: cab: .*safetensors"):
        await Server(settings(models=tmp_path, default_model="cab")).start()
    server = Server(settings(models=tmp_path, default_model="kalman", max_batch_agents=2))
    with capture_logs() as logs:
        await server.start()
    await server.stop()
    assert [entry["log_level"] for entry in logs if entry["event"] == "model refused"] == ["warning"]


async def test_it_listens_before_it_is_ready() -> None:
    fake = FakeForecaster()
    fake.free.clear()
    server = Server(settings(default_model="fake"), load=lambda _: registry(fake))
    starting = asyncio.create_task(server.start())
    assert await asyncio.to_thread(fake.entered.wait, 10)  # warming up
    async with httpx.AsyncClient(base_url=f"http://{server.http_address}") as client:
        assert (await client.get("/livez")).status_code == 200
        assert (await client.get("/readyz")).status_code == 503
        assert (await client.get("/v1/models")).status_code == 503
        fake.free.set()
        await starting
        assert (await client.get("/readyz")).status_code == 200
    await server.stop()


async def test_stop_answers_what_was_accepted() -> None:
    fake = FakeForecaster()
    async with running(fake) as server:
        fake.free.clear()
        calls = [asyncio.create_task(call_grpc(server, make_request(1)))]
        assert await asyncio.to_thread(fake.entered.wait, 10)
        calls.append(asyncio.create_task(call_rest(server, make_request(1))))
        await until_waiting(server, 1)
        stopping = asyncio.create_task(server.stop())
        await asyncio.sleep(0.05)
        fake.free.set()
        await stopping
        for response in await asyncio.gather(*calls):
            assert len(response.forecasts) == 1


async def health(server: Server) -> int:
    async with grpc.aio.insecure_channel(server.grpc_address) as channel:
        asked = health_pb2.HealthCheckRequest()
        return int((await health_pb2_grpc.HealthStub(channel).Check(asked)).status)


async def test_a_forward_that_hangs_makes_the_server_not_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.server._READINESS_PERIOD", 0.02)
    fake = FakeForecaster()
    async with running(fake, max_timeout=0.3) as server, httpx.AsyncClient() as client:
        ready = f"http://{server.http_address}/readyz"
        assert (await client.get(ready)).status_code == 200
        fake.free.clear()
        with pytest.raises(CallError) as caught:
            await call_grpc(server, make_request(1))
        assert caught.value.code == "DEADLINE_EXCEEDED"
        async with asyncio.timeout(10):
            while (refused := await client.get(ready)).status_code == 200:  # noqa: ASYNC110
                await asyncio.sleep(0.02)
            assert refused.status_code == 503
            assert "has not returned for" in refused.json()["detail"]
            while await health(server) != health_pb2.HealthCheckResponse.NOT_SERVING:  # noqa: ASYNC110
                await asyncio.sleep(0.02)
            fake.free.set()
            while (await client.get(ready)).status_code != 200:  # noqa: ASYNC110
                await asyncio.sleep(0.02)
            while await health(server) != health_pb2.HealthCheckResponse.SERVING:  # noqa: ASYNC110
                await asyncio.sleep(0.02)


async def test_a_crash_of_the_batcher_ends_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = FakeForecaster()
    server = Server(settings(default_model="fake"), load=lambda _: registry(fake))
    ready = threading.Event()
    serving = asyncio.create_task(server.run(lambda _: ready.set()))
    assert await asyncio.to_thread(ready.wait, 30)
    monkeypatch.setattr(server.dataplane._batcher, "_deliver", Mock(side_effect=RuntimeError("a bug")))
    with pytest.raises(CallError) as caught:
        await call_grpc(server, make_request(1))
    assert caught.value.code == "INTERNAL"
    assert server.dataplane.phase is Phase.FAILED
    async with asyncio.timeout(20):
        with pytest.raises(ServeError):
            await serving


_PACE = 0.008
"""s between reads of 64 KiB: some 2.5 s for an answer."""


def long_answer() -> bytes:
    """A request for 19 MB: more than the buffers on the way take."""
    return make_request(100, samples=1000, seed=1).SerializeToString()


async def read_slowly(reader: asyncio.StreamReader) -> AsyncIterator[bytes]:
    while chunk := await reader.read(2**16):
        yield chunk
        await asyncio.sleep(_PACE)


async def connect(address: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A connection with small buffers of its own."""
    connected = socket.socket()
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**16)
    connected.setblocking(False)
    host, port = address.split(":")
    await asyncio.get_running_loop().sock_connect(connected, (host, int(port)))
    return await asyncio.open_connection(sock=connected, limit=2**16)


async def close(writer: asyncio.StreamWriter) -> None:
    writer.close()
    with suppress(ConnectionError):
        await writer.wait_closed()


async def send_over_http(server: Server) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    body = long_answer()
    reader, writer = await connect(server.http_address)
    head = "POST /v1/predict HTTP/1.1\r\nHost: x\r\nContent-Type: application/x-protobuf\r\n"
    writer.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
    return reader, writer


async def test_stop_waits_for_those_who_read_slowly_over_http() -> None:
    async with running(FakeForecaster()) as server:
        reader, writer = await send_over_http(server)
        answer = bytearray(await reader.readuntil(b"\r\n\r\n"))
        [length] = [
            int(v)
            for k, _, v in (h.partition(b": ") for h in answer.split(b"\r\n"))
            if k == b"content-length"
        ]
        stopping = asyncio.create_task(server.stop())
        body = b"".join([chunk async for chunk in read_slowly(reader)])
        await stopping
        await close(writer)
    assert length > 15_000_000
    assert len(body) == length


@asynccontextmanager
async def slow_proxy(address: str) -> AsyncIterator[str]:
    """Carries bytes to a server at once, and slowly back."""

    async def carry(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        server_reader, server_writer = await connect(address)

        async def send() -> None:
            while chunk := await reader.read(2**16):
                server_writer.write(chunk)

        sending = asyncio.create_task(send())
        async for chunk in read_slowly(server_reader):
            writer.write(chunk)
            await writer.drain()
        sending.cancel()
        for end in (server_writer, writer):
            await close(end)

    carrying: list[asyncio.Task[None]] = []
    proxy = await asyncio.start_server(
        lambda *ends: carrying.append(asyncio.create_task(carry(*ends))), "127.0.0.1", 0
    )
    async with proxy:
        yield f"127.0.0.1:{proxy.sockets[0].getsockname()[1]}"
    await asyncio.gather(*carrying)


async def test_stop_waits_for_those_who_read_slowly_over_grpc() -> None:
    options = [("grpc.max_receive_message_length", -1), ("grpc.use_local_subchannel_pool", 1)]
    request = long_answer()
    async with (
        running(FakeForecaster()) as server,
        slow_proxy(server.grpc_address) as address,
        grpc.aio.insecure_channel(address, options=options) as channel,
    ):
        predict = channel.unary_unary(PREDICT, None, None)
        await predict(make_request(1).SerializeToString())
        call = asyncio.ensure_future(predict(request))
        async with asyncio.timeout(20):
            # Sent, but not out: the agents are counted when the answer is made
            while server.metrics.registry.get_sample_value(*_AGENTS_OK) != 101:  # noqa: ASYNC110
                await asyncio.sleep(0.01)
        started = time.monotonic()
        await server.stop()
        assert len(await call) > 15_000_000
        assert time.monotonic() - started > 1.5  # or the test has shown nothing


_AGENTS_OK = ("forecast_agents_total", {"model": "fake", "status": "ok"})


async def test_stop_gives_up_on_those_who_do_not_read() -> None:
    async with running(FakeForecaster(), drain_seconds=0.5) as server:
        reader, writer = await send_over_http(server)
        await reader.readexactly(1)
        started = time.monotonic()
        await server.stop()
        assert 0.4 < time.monotonic() - started < 5
        with pytest.raises((asyncio.IncompleteReadError, ConnectionError)):
            await reader.readexactly(19_000_000)
        await close(writer)


async def test_a_request_that_is_still_coming_was_accepted() -> None:
    body = make_request(1).SerializeToString()
    async with running(FakeForecaster()) as server:
        reader, writer = await connect(server.http_address)
        head = "POST /v1/predict HTTP/1.1\r\nHost: x\r\nContent-Type: application/x-protobuf\r\n"
        writer.write(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body[:10])
        async with asyncio.timeout(10):
            while not server.dataplane._lifecycle.calls:  # noqa: ASYNC110 - no event tells
                await asyncio.sleep(0.005)
        stopping = asyncio.create_task(server.stop())
        await asyncio.sleep(0.2)
        writer.write(body[10:])
        assert (await reader.read(2**16)).startswith(b"HTTP/1.1 200 OK")
        await stopping
        await close(writer)


async def test_a_body_that_does_not_come_is_late() -> None:
    async with running(FakeForecaster(), max_timeout=0.2) as server:
        reader, writer = await connect(server.http_address)
        writer.write(b"POST /v1/predict HTTP/1.1\r\nHost: x\r\nContent-Length: 10\r\n\r\n{")
        assert (await reader.readline()).startswith(b"HTTP/1.1 504")
        await close(writer)


async def test_stop_waits_for_no_health_watch() -> None:
    statuses = health_pb2.HealthCheckResponse
    async with (
        running(FakeForecaster()) as server,
        grpc.aio.insecure_channel(server.grpc_address) as channel,
    ):
        watch = health_pb2_grpc.HealthStub(channel).Watch(health_pb2.HealthCheckRequest())
        assert (await watch.read()).status == statuses.SERVING
        started = time.monotonic()
        await server.stop()
        assert time.monotonic() - started < 5
        assert (await watch.read()).status == statuses.NOT_SERVING
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await watch.read()
        assert caught.value.code() is grpc.StatusCode.UNAVAILABLE


@pytest.mark.parametrize(("tokens", "told"), [((), "off: every caller is accepted"), (("t",), "keys")])
async def test_the_log_says_who_is_let_in(tokens: tuple[str, ...], told: str) -> None:
    with capture_logs() as logs:
        async with running(FakeForecaster(), api_tokens=tokens):
            pass
    assert [entry["authentication"] for entry in logs if entry["event"] == "listening"] == [told]


@pytest.mark.parametrize(
    ("body", "content_type"),
    [
        (b"\x22\x00" * (8 * 2**20 - 1), "application/x-protobuf"),
        (b'{"agents":[' + b"{}," * 5_000_000 + b"{}]}", "application/json"),
    ],
    ids=["protobuf", "json"],
)
async def test_a_million_agents_are_refused_in_no_time(body: bytes, content_type: str) -> None:
    async with running(FakeForecaster()) as server:
        with pytest.raises(CallError) as caught:
            await call_rest(server, body, {"content-type": content_type})
        assert (caught.value.reason, caught.value.message) == ("TOO_LARGE", _TOO_LARGE[content_type])
        if content_type == "application/x-protobuf":
            with pytest.raises(CallError, match="more than 512 agents"):
                await call_grpc(server, body)


_TOO_LARGE = {
    "application/x-protobuf": "more than 512 agents",
    "application/json": "more objects and lists than 512 agents and 262144 states can have",
}


async def test_stop_does_not_wait_for_ever() -> None:
    fake = FakeForecaster()
    async with running(fake, drain_seconds=0.1) as server:
        fake.free.clear()
        call = asyncio.create_task(call_grpc(server, make_request(1)))
        assert await asyncio.to_thread(fake.entered.wait, 10)
        asyncio.get_running_loop().call_later(2, fake.free.set)  # a forward cannot be stopped
        await server.stop()
        assert isinstance((await asyncio.gather(call, return_exceptions=True))[0], Exception)


async def test_models_are_the_baselines_when_none_are_bundled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.predict.models_folder.bundled_models", lambda: None)
    server_models = Server(Settings())._load(None)
    assert isinstance(server_models, Registry)
    assert "kalman" in server_models


def as_bundled(folder: Path) -> None:
    """Write checkpoints as they come with the package: one name under both protocols."""
    copy_bundled(folder / "1.0.0", "cab", "1.0.0")
    copy_bundled(folder / "1.0.0+paper", "cab-paper", "1.0.0+paper")


async def test_the_bundled_cab_is_the_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    as_bundled(tmp_path)
    monkeypatch.setattr("service.predict.models_folder.bundled_models", lambda: tmp_path)
    server = Server(settings(max_batch_agents=8))
    with capture_logs() as logs:
        await server.start()
    try:
        (told,) = (entry for entry in logs if "skipped" in entry["event"])
        assert (told["log_level"], told["models"]) == ("info", ["cab@1.0.0+paper"])
        assert "--allow-paper-protocol" in told["load_with"]
        answer = await call_grpc(server, make_request(1))
        assert (answer.model.name, answer.model.version) == ("cab", "1.0.0")
        with pytest.raises(CallError, match=r"so cab@1\.0\.0\+paper was not loaded") as caught:
            await call_rest(server, make_request(1, model="cab@1.0.0+paper"))
        assert caught.value.code == "NOT_FOUND"
    finally:
        await server.stop()


async def test_both_protocols_of_a_name_are_served_once_allowed(tmp_path: Path) -> None:
    as_bundled(tmp_path)
    server = Server(settings(models=tmp_path, allow_paper_protocol=True, max_batch_agents=8))
    await server.start()
    try:
        async with AsyncClient(f"http://{server.http_address}") as client:
            found = [model for model in await client.list_models() if model.name == "cab"]
            assert [(model.version, model.protocol, model.is_default) for model in found] == [
                ("1.0.0", models_pb.INPUT_PROTOCOL_CAUSAL, True),
                ("1.0.0+paper", models_pb.INPUT_PROTOCOL_PAPER, False),
            ]
            assert await client.get_model("cab@1.0.0+paper") == found[1]
        for name, version in (("", "1.0.0"), ("cab", "1.0.0"), ("cab@1.0.0+paper", "1.0.0+paper")):
            for call in TRANSPORTS.values():
                answer = await call(server, make_request(1, model=name))
                assert answer.model.version == version
                paper = version == "1.0.0+paper"
                assert (answer.model.protocol == models_pb.INPUT_PROTOCOL_PAPER) is paper
                assert any("paper protocol" in warning for warning in answer.warnings) is paper
    finally:
        await server.stop()


async def test_a_folder_of_ones_own_warns_and_one_of_the_paper_protocol_alone_is_refused(
    tmp_path: Path,
) -> None:
    as_bundled(tmp_path)
    with capture_logs() as logs:
        assert Server(settings(models=tmp_path))._load(None).get("cab").info.version == "1.0.0"
    assert [entry["log_level"] for entry in logs if "skipped" in entry["event"]] == ["warning"]
    shutil.rmtree(tmp_path / "1.0.0")
    with pytest.raises(StartError, match=r"paper protocol, and there is no other .*--allow-paper-protocol"):
        await Server(settings(models=tmp_path)).start()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_drains(number: signal.Signals, tmp_path: Path) -> None:
    with process("--log-json", "--models", str(tmp_path)) as started:  # an empty folder: the baselines
        _, address = ready(started)
        request = make_request(500, samples=200).SerializeToString()
        with grpc.insecure_channel(address, options=[("grpc.max_receive_message_length", -1)]) as channel:
            grpc.channel_ready_future(channel).result(timeout=10)
            predict = channel.unary_unary(PREDICT, None, None)
            predict(make_request(1).SerializeToString(), timeout=10)
            calls = [predict.future(request, timeout=20) for _ in range(3)]
            predict(make_request(1).SerializeToString(), timeout=20)  # came after them on the same channel
            started.send_signal(number)
            answered = [call.result(timeout=20) for call in calls]
        assert all(len(answer) > 1_000_000 for answer in answered)
        assert started.wait(15) == 0


def test_the_demo_is_printed_and_moves_until_the_server_ends() -> None:
    with process("--log-json", "--demo") as started:
        assert started.stdout is not None
        http, address = ready(started)
        lines: list[str] = []
        while not lines or "Traffic moves" not in lines[-1]:
            lines.append(next(started.stdout))
        assert any("vehicle" in line for line in lines)
        assert f"open http://{http}/ " in lines[-1]
        with Client(address) as client:
            _wait_for_scene(client, "demo/junction")
        children = psutil.Process(started.pid).children()  # the traffic, and workers if there are any
        started.send_signal(signal.SIGTERM)
        assert started.wait(15) == 0
        assert children
        assert not any(child.is_running() for child in children)


def _wait_for_scene(client: Client, scene_id: str) -> None:
    """Wait until a scene is remembered."""
    deadline = time.monotonic() + 30
    while True:
        try:
            client.scene_consistency(scene_id)
        except UnknownTrack:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        else:
            return


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--default-model", "nobody"], "there is no model 'nobody'"),
        (["--store", "memcached://localhost"], "store: "),
        (["--models", "/no/such/folder"], "no such folder"),
        (["--config", "/no/such/file.toml"], "no such configuration file"),
    ],
)
def test_failures_end_with_one_line_and_code_one(arguments: list[str], message: str) -> None:
    with process(*arguments) as started:
        _, errors = started.communicate(timeout=30)
        assert started.returncode == 1
        assert message in " ".join(errors.split())
        assert "Traceback" not in errors
