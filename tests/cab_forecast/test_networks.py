"""Clients in networks: names with several addresses, and proxies in the environment."""

import asyncio
import socket

import pytest

from cab.forecast.v1.model_service_pb2 import Model
from cab_forecast import AsyncClient, Client
from tests.resolver import resolving
from tests.service.fakes import FakeForecaster
from tests.service.servers import count, in_thread, running, settings

_NAME = "forecast.test"


async def test_calls_go_in_turn_to_all_addresses_of_a_name_and_to_those_that_are_left() -> None:
    async with running(FakeForecaster()) as first:
        port = first.grpc_address.rpartition(":")[2]
        async with (
            resolving("127.0.0.1", "127.0.0.2") as resolver,
            AsyncClient(f"dns://{resolver}/{_NAME}:{port}", timeout=20) as client,
        ):
            async with running(FakeForecaster(), grpc=f"127.0.0.2:{port}") as second:
                while not count(first, "grpc", "ListModels", "OK"):
                    await client.list_models()
                before = [count(each, "grpc", "ListModels", "OK") for each in (first, second)]
                for _ in range(20):
                    await client.list_models()
                after = [count(each, "grpc", "ListModels", "OK") for each in (first, second)]
                assert [late - early for early, late in zip(before, after, strict=True)] == [10, 10]
            for _ in range(20):
                await client.list_models()
            assert count(first, "grpc", "ListModels", "OK") == after[0] + 20


def test_a_proxy_in_the_environment_is_not_asked_for_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as proxy:
        where = "http://{}:{}".format(*proxy.getsockname())
        for name in ("grpc_proxy", "http_proxy", "https_proxy", "all_proxy"):
            monkeypatch.setenv(name, where)
            monkeypatch.setenv(name.upper(), where)
        for name in ("no_proxy", "no_grpc_proxy"):
            monkeypatch.delenv(name, raising=False)
            monkeypatch.delenv(name.upper(), raising=False)
        with in_thread(settings()) as server:
            for endpoint in (f"grpc://{server.grpc_address}", f"http://{server.http_address}"):
                with Client(endpoint, retries=0, timeout=10) as client:
                    assert client.list_models()
                assert asyncio.run(list_models(endpoint))
        proxy.setblocking(False)
        with pytest.raises(BlockingIOError):  # neither by the client nor by the server and its libraries
            proxy.accept()


async def list_models(endpoint: str) -> list[Model]:
    """Return the models by a client for asyncio."""
    async with AsyncClient(endpoint, retries=0, timeout=10) as client:
        return await client.list_models()
