"""The server's life: starting, failing to start, draining, as a process of its own."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import grpc
import httpx
import pytest

from cab_forecast import Client
from model.registry import Registry
from service.server import Server, StartError
from service.settings import Settings
from tests.service.fakes import FakeForecaster, registry
from tests.service.requests import make_request
from tests.service.servers import PREDICT, call_grpc, call_rest, running, settings, until_waiting


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
    (tmp_path / "broken").mkdir()
    with pytest.raises(StartError, match="broken"):
        await Server(settings(models=tmp_path)).start()


async def test_it_listens_before_it_is_ready() -> None:
    fake = FakeForecaster()
    fake.free.clear()
    server = Server(settings(default_model="fake"), load=lambda: registry(fake))
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
    monkeypatch.setattr("service.server.bundled_models", lambda: None)
    server_models = Server(Settings())._load()
    assert isinstance(server_models, Registry)
    assert "kalman" in server_models


@contextmanager
def process(*arguments: str) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, "-m", "service", "serve", "--http", "127.0.0.1:0", "--grpc", "127.0.0.1:0"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("FORECAST_")}
    with subprocess.Popen(  # noqa: S603 - ourselves
        [*command, *arguments], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as started:
        try:
            yield started
        finally:
            started.kill()


def ready(started: "subprocess.Popen[str]") -> tuple[str, str]:
    """HTTP and gRPC addresses, once it is ready."""
    assert started.stderr is not None
    for line in started.stderr:
        entry = json.loads(line)
        if entry["event"] == "ready":
            return entry["http"], entry["grpc"]
    raise AssertionError("it ended before it was ready")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_drains(number: signal.Signals) -> None:
    with process("--log-json") as started:
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


def test_demo_is_printed() -> None:
    with process("--log-json", "--demo") as started:
        assert started.stdout is not None
        _, address = ready(started)
        lines = [next(started.stdout) for _ in range(3)]
        assert any("vehicle" in line for line in lines)
        with Client(address) as client:
            assert client.list_models()
        started.send_signal(signal.SIGTERM)
        assert started.wait(15) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--default-model", "nobody"], "there is no model 'nobody'"),
        (["--store", "redis://localhost"], "is not supported"),
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
