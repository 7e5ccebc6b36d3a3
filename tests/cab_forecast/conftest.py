"""The client in all its forms: blocking and asyncio, over gRPC and over REST with both encodings."""

import asyncio
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from cab_forecast import AsyncClient, Client
from tests.cab_forecast.fakes import Script, grpc_fake, http_fake

Call = Callable[..., Any]


@pytest.fixture
def script() -> Script:
    """Provide the script of the fake server."""
    return Script()


@pytest.fixture(params=["grpc", "http", "http-json"])
def server(request: pytest.FixtureRequest, script: Script) -> Iterator[tuple[str, dict[str, Any]]]:
    """Run a fake server; yield its endpoint and the other client arguments."""
    fake = grpc_fake if request.param == "grpc" else http_fake
    with fake(script) as address:
        scheme = "grpc" if request.param == "grpc" else "http"
        yield f"{scheme}://{address}", {"encoding": "json"} if request.param == "http-json" else {}


@pytest.fixture(params=["blocking", "asyncio"])
def call_at(request: pytest.FixtureRequest) -> Call:
    """``call_at(endpoint, client_arguments, method, *arguments, **arguments)`` with a client of one kind."""

    def blocking(endpoint: str, settings: dict[str, Any], method: str, *args: Any, **kwargs: Any) -> Any:
        with Client(endpoint, **settings) as client:
            return getattr(client, method)(*args, **kwargs)

    async def with_asyncio(
        endpoint: str, settings: dict[str, Any], method: str, *args: Any, **kwargs: Any
    ) -> Any:
        async with AsyncClient(endpoint, **settings) as client:
            return await getattr(client, method)(*args, **kwargs)

    def asynchronous(*args: Any, **kwargs: Any) -> Any:
        return asyncio.run(with_asyncio(*args, **kwargs))

    return blocking if request.param == "blocking" else asynchronous


@pytest.fixture
def call(call_at: Call, server: tuple[str, dict[str, Any]]) -> Call:
    """``call(client_arguments, method, …)`` to the fake server."""
    endpoint, encoding = server
    return lambda settings, *args, **kwargs: call_at(endpoint, settings | encoding, *args, **kwargs)
