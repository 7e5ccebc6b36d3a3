"""API keys with real servers: scopes, limits, revocation, and what is served beside the contract."""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

import httpx
import pytest
from structlog.testing import capture_logs

from cab.forecast.v1.consistency_service_pb2 import GetAgentConsistencyRequest
from cab_forecast import AsyncClient, LimitExceeded, PermissionDenied, Unauthenticated
from service.access.key_file import Key, digest, write_keys
from service.access.scopes import Scope
from service.server import Server
from tests.service.fakes import FakeForecaster
from tests.service.planes import with_fake_plane
from tests.service.requests import make_request
from tests.service.servers import GET_AGENT_BY, TRANSPORTS, CallError, count, running, until

Call = Callable[..., Coroutine[Any, Any, object]]
ASKED = GetAgentConsistencyRequest(scene_id="s", agent_id="a")
SECRET = "cabf_a-key-that-no-log-may-show"  # noqa: S105


@pytest.fixture(params=TRANSPORTS)
def transport(request: pytest.FixtureRequest) -> str:
    """Return the name of one of the transports."""
    return str(request.param)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "keys.json"


def key(name: str, scopes: Sequence[Scope] = (Scope.PREDICT,), **limits: float) -> Key:
    """Return a key whose secret is SECRET and its name."""
    return Key.model_validate({"name": name, "sha256": digest(SECRET + name), "scopes": scopes, **limits})


def held_by(name: str) -> dict[str, str]:
    """Return the headers of a key's holder."""
    return {"authorization": f"Bearer {SECRET}{name}"}


async def failure(awaitable: Awaitable[object]) -> CallError:
    with pytest.raises(CallError) as caught:
        await awaitable
    assert SECRET not in str(caught.value)
    return caught.value


def check(error: CallError, code: str, http_status: int, reason: str) -> None:
    assert (error.code, error.reason) == (code, reason)
    assert error.http_status in (None, http_status)


def sample(server: Server, name: str, **labels: str) -> float | None:
    return server.metrics.registry.get_sample_value(name, labels)


def client(server: Server, transport: str, name: str) -> AsyncClient:
    endpoint = f"grpc://{server.grpc_address}" if transport == "grpc" else f"http://{server.http_address}"
    return AsyncClient(endpoint, SECRET + name, retries=0)


async def test_scopes(transport: str, file: Path) -> None:
    write_keys(file, [key("driver"), key("reader", [Scope.READ])])
    predict, get_agent = TRANSPORTS[transport], GET_AGENT_BY[transport]
    with capture_logs() as logs:
        async with running(keys_file=file, max_batch_agents=2) as server:
            with_fake_plane(server)
            assert await predict(server, make_request(), held_by("driver"))
            assert await get_agent(server, ASKED, held_by("reader"))
            refused = await failure(predict(server, make_request(), held_by("reader")))
            check(refused, "PERMISSION_DENIED", 403, "MISSING_SCOPE")
            assert refused.message == "the key lacks the scope predict"
            assert refused.retry_after is None
            check(
                await failure(get_agent(server, ASKED, held_by("driver"))),
                "PERMISSION_DENIED",
                403,
                "MISSING_SCOPE",
            )
            for wrong in ({}, held_by("stranger")):
                unknown = await failure(predict(server, make_request(), wrong))
                check(unknown, "UNAUTHENTICATED", 401, "UNAUTHENTICATED")
            async with client(server, transport, "reader") as reader:
                assert await reader.list_models()  # any key may
                with pytest.raises(PermissionDenied):
                    await reader.reset_scene("s")
                with pytest.raises(PermissionDenied):
                    await reader.predict(make_request())
            async with client(server, transport, "driver") as driver:
                with pytest.raises(PermissionDenied):
                    async with driver.watch_scene("s"):
                        pass
            assert count(server, transport, "Predict", "PERMISSION_DENIED") == 2
            assert count(server, transport, "Predict", "UNAUTHENTICATED") == 2
            requests = "forecast_key_requests_total"
            assert sample(server, requests, key="driver", code="OK") == 1
            assert sample(server, requests, key="reader", code="PERMISSION_DENIED") == 3
            assert sample(server, "forecast_key_refused_total", key="reader", reason="scope") == 3
            assert SECRET not in server.metrics.render().decode()
    assert SECRET not in str(logs)


async def test_a_rate_is_for_one_key_alone(transport: str, file: Path) -> None:
    write_keys(file, [key("greedy", agents_per_second=8.0), key("modest", agents_per_second=8.0)])
    predict = TRANSPORTS[transport]
    async with running(FakeForecaster(), keys_file=file, max_batch_agents=8) as server:
        assert await predict(server, make_request(8), held_by("greedy"))
        excess = await failure(predict(server, make_request(8), held_by("greedy")))
        check(excess, "RESOURCE_EXHAUSTED", 429, "LIMIT_EXCEEDED")
        assert excess.retry_after is not None
        assert 0 < excess.retry_after <= 1
        assert await predict(server, make_request(8), held_by("modest"))
        assert sample(server, "forecast_key_agents_total", key="modest") == 8
        assert sample(server, "forecast_key_refused_total", key="greedy", reason="limit") == 1
        assert sample(server, "forecast_key_refused_total", key="modest", reason="limit") == 0
        assert sample(server, "forecast_refused_total", reason="concurrency") == 0
        async with client(server, transport, "greedy") as greedy:
            for _ in range(20):  # calls that hold no agents count, too
                try:
                    await greedy.list_models()
                except LimitExceeded:
                    break
            else:
                pytest.fail("the rate bounds forecasts only")


async def test_a_key_can_have_a_default_model_of_its_own(file: Path) -> None:
    write_keys(file, [key("truck"), key("car")])
    other = FakeForecaster("other")
    models = {"default_models": "truck=other", "keys_file": file, "max_batch_agents": 2}
    async with running(FakeForecaster(), other, **models) as server:
        for predict in TRANSPORTS.values():
            assert (await predict(server, make_request(), held_by("truck"))).model.name == "other"
            assert (await predict(server, make_request(), held_by("car"))).model.name == "fake"
        for transport in TRANSPORTS:
            for holder, default in (("truck", "other"), ("car", "fake")):
                async with client(server, transport, holder) as calls:
                    listed = await calls.list_models()
                    assert [model.name for model in listed if model.is_default] == [default]
                    assert (await calls.get_model(default)).is_default


async def test_agents_in_progress_are_for_one_key_alone(transport: str, file: Path) -> None:
    write_keys(file, [key("greedy", concurrent_agents=3), key("modest")])
    predict = TRANSPORTS[transport]
    fake = FakeForecaster()
    async with running(fake, keys_file=file, max_batch_agents=4, max_concurrent_calls=3) as server:
        fake.free.clear()
        first = asyncio.create_task(predict(server, make_request(2), held_by("greedy")))
        await until(fake.entered.is_set)
        check(
            await failure(predict(server, make_request(2), held_by("greedy"))),
            "RESOURCE_EXHAUSTED",
            429,
            "LIMIT_EXCEEDED",
        )
        greedy = server.access.gate.identify(held_by("greedy")["authorization"])
        await until(lambda: greedy._usage.agents == 2)  # a refused call counts until its error was sent
        too_large = await failure(predict(server, make_request(4), held_by("greedy")))
        check(too_large, "RESOURCE_EXHAUSTED", 413, "TOO_LARGE")
        await until(lambda: greedy._usage.agents == 2)
        second = asyncio.create_task(predict(server, make_request(1), held_by("greedy")))
        await until(lambda: greedy._usage.agents == 3)
        for _ in range(10):  # refused on arrival, these take no place of the others
            check(
                await failure(predict(server, b"no message", held_by("greedy"))),
                "RESOURCE_EXHAUSTED",
                429,
                "LIMIT_EXCEEDED",
            )
        other = asyncio.create_task(predict(server, make_request(4), held_by("modest")))
        await until(lambda: server.intake.calls == 3)  # those of greedy, and this one
        fake.free.set()
        assert await asyncio.gather(first, second, other)
        assert await predict(server, make_request(3), held_by("greedy"))  # all places were given back


async def test_streams_are_bounded_and_end_with_their_key(transport: str, file: Path) -> None:
    write_keys(file, [key("watcher", [Scope.READ], streams=1), key("other", [Scope.READ])])
    async with running(keys_file=file, max_batch_agents=2) as server:
        plane = with_fake_plane(server)
        async with (
            client(server, transport, "watcher") as watcher,
            client(server, transport, "other") as other,
        ):
            watched, others = watcher.watch_scene("s"), other.watch_scene("s")
            async with watched, others:
                with pytest.raises(LimitExceeded):
                    async with watcher.watch_scene("s"):
                        pass
                write_keys(file, [key("other", [Scope.READ])])
                await server.access.refresh()
                with pytest.raises(Unauthenticated, match="revoked"):
                    await anext(watched)
                assert plane.watching == 1
        await until(lambda: plane.watching == 0)


async def test_a_changed_file_takes_effect_by_itself(
    transport: str, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.access.access._PERIOD", 0.02)
    predict = TRANSPORTS[transport]

    write_keys(file, [key("old")])
    async with running(keys_file=file, max_batch_agents=2) as server:
        assert await predict(server, make_request(), held_by("old"))
        await failure(predict(server, make_request(), held_by("new")))
        write_keys(file, [key("new")])
        await until(lambda: sample(server, "forecast_key_agents_total", key="new") == 0)
        assert await predict(server, make_request(), held_by("new"))
        check(
            await failure(predict(server, make_request(), held_by("old"))),
            "UNAUTHENTICATED",
            401,
            "UNAUTHENTICATED",
        )


async def test_metrics_and_documentation_follow_the_same_rule(file: Path) -> None:
    write_keys(file, [key("driver"), key("prometheus", [Scope.METRICS], agents_per_second=1.0)])
    async with (
        running(keys_file=file, max_batch_agents=2) as server,
        httpx.AsyncClient(base_url=f"http://{server.http_address}") as http,
    ):
        for path in ("/livez", "/readyz"):
            assert (await http.get(path)).status_code == 200
        for path in ("/metrics", "/docs", "/openapi.json", "/static-offline-docs/swagger-ui.css", "/nothing"):
            response = await http.get(path)
            assert response.status_code == 401
            assert response.json()["reason"] == "UNAUTHENTICATED"
            assert response.headers["WWW-Authenticate"].startswith("Basic realm=")
        response = await http.post("/v1/predict", headers={"authorization": "Basic eDp4"})
        assert response.headers["WWW-Authenticate"] == "Bearer"
        assert (await http.get("/metrics", headers=held_by("driver"))).status_code == 403
        assert (await http.get("/metrics", headers=held_by("prometheus"))).status_code == 200
        assert (await http.get("/metrics", headers=held_by("prometheus"))).status_code == 429
        for path in ("/docs", "/openapi.json", "/static-offline-docs/swagger-ui.css"):
            assert (await http.get(path, auth=("", f"{SECRET}driver"))).status_code == 200
        assert (await http.get("/nothing", headers=held_by("driver"))).status_code == 404
        document = (await http.get("/openapi.json", headers=held_by("driver"))).json()
        assert document["components"]["securitySchemes"] == {"bearer": {"type": "http", "scheme": "bearer"}}


async def test_tokens_go_on_working(transport: str) -> None:
    async with running(api_tokens=("token",), max_batch_agents=2) as server:
        headers = {"authorization": "Bearer token"}
        assert await TRANSPORTS[transport](server, make_request(), headers)
        check(
            await failure(TRANSPORTS[transport](server, make_request())),
            "UNAUTHENTICATED",
            401,
            "UNAUTHENTICATED",
        )
        assert sample(server, "forecast_key_requests_total", key="(api_tokens)", code="OK") == 1
        async with httpx.AsyncClient() as http:
            assert (
                await http.get(f"http://{server.http_address}/metrics", headers=headers)
            ).status_code == 200


async def test_pages_of_other_origins_may_call_only_if_they_are_named() -> None:
    ask = {"origin": "https://tools.example.com", "access-control-request-method": "POST"}
    async with running(max_batch_agents=2) as server, httpx.AsyncClient() as http:
        response = await http.options(f"http://{server.http_address}/v1/predict", headers=ask)
        assert response.status_code == 405
        assert "access-control-allow-origin" not in response.headers
    named = ("https://tools.example.com",)
    async with (
        running(max_batch_agents=2, cors_origins=named, api_tokens=("token",)) as server,
        httpx.AsyncClient() as http,
    ):
        url = f"http://{server.http_address}/v1/predict"
        response = await http.options(url, headers=ask | {"access-control-request-headers": "authorization"})
        assert response.status_code == 200
        assert response.headers["access-control-allow-origin"] == named[0]
        response = await http.options(url, headers=ask | {"origin": "https://other.example.com"})
        assert "access-control-allow-origin" not in response.headers
        assert (await http.post(url, headers={"origin": named[0]})).status_code == 401
