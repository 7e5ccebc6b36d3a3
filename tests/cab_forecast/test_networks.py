"""Clients in networks: names with several addresses, and proxies in the environment."""

import asyncio
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from cab.forecast.v1.model_service_pb2 import Model
from cab_forecast import AsyncClient, Client
from tests.service.fakes import FakeForecaster
from tests.service.servers import count, in_thread, running, settings

_NAME = "forecast.test"
_A, _IN = 1, 1
"""Type and class of a DNS record, RFC 1035."""


class Resolver(asyncio.DatagramProtocol):
    """DNS server that answers every question with the same IPv4 addresses."""

    def __init__(self) -> None:
        self.addresses: list[str] = []
        self.transport: Any = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = transport

    def datagram_received(self, data: bytes, address: tuple[str, int]) -> None:
        end = data.index(b"\0", 12) + 5
        kind, _ = struct.unpack(">HH", data[end - 4 : end])
        records = [
            struct.pack(">HHHIH", 0xC00C, _A, _IN, 0, 4) + socket.inet_aton(each)
            for each in self.addresses
            if kind == _A
        ]
        head = data[:2] + struct.pack(">HHHHH", 0x8180, 1, len(records), 0, 0)
        self.transport.sendto(head + data[12:end] + b"".join(records), address)


@asynccontextmanager
async def resolving(*addresses: str) -> AsyncIterator[str]:
    """Run a DNS server; yield its address."""
    transport, resolver = await asyncio.get_running_loop().create_datagram_endpoint(
        Resolver, local_addr=("127.0.0.1", 0)
    )
    resolver.addresses += addresses
    try:
        host, port = transport.get_extra_info("sockname")
        yield f"{host}:{port}"
    finally:
        transport.close()


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
