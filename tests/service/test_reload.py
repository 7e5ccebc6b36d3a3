"""Reload of the models while the server answers calls."""

import asyncio
import gc
import os
import shutil
import signal
import threading
import weakref
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from structlog.testing import capture_logs

from cab.forecast.v1 import admin_service_pb2 as admin_pb
from cab_forecast import AsyncClient, ForecastError, PermissionDenied, Unauthenticated
from model.registry import Registry
from service.predict.catalog import Models
from service.server import Server
from tests.model.checkpoints import copy_bundled
from tests.service.fakes import FakeForecaster, registry
from tests.service.requests import make_request
from tests.service.servers import TRANSPORTS, call_grpc, running, settings, until

SMALL = "trajectron-no-context"
Call = Callable[..., Coroutine[Any, Any, Any]]


class Shelf:
    """Source of models that a test changes."""

    def __init__(self, *forecasters: FakeForecaster) -> None:
        self.forecasters = list(forecasters)
        self.baselines = registry()

    def __call__(self, _: Models | None) -> Registry:
        standing = [self.baselines.get(info.full_name) for info in self.baselines.infos()]
        return Registry([*standing, *self.forecasters])


@asynccontextmanager
async def serving(shelf: Shelf, **values: Any) -> AsyncIterator[Server]:
    server = Server(settings(**({"default_model": "fake", "max_batch_agents": 4} | values)), load=shelf)
    await server.start()
    try:
        yield server
    finally:
        for forecaster in shelf.forecasters:
            forecaster.free.set()
        await server.stop()


def address(server: Server, transport: str) -> str:
    return f"http://{server.http_address}" if transport == "rest" else server.grpc_address


async def reload(server: Server, transport: str = "grpc") -> admin_pb.ReloadModelsResponse:
    async with AsyncClient(address(server, transport), timeout=20) as client:
        return await client.reload_models()


def reloads(server: Server, result: str) -> float | None:
    return server.metrics.registry.get_sample_value("forecast_model_reloads_total", {"result": result})


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_calls_in_progress_keep_the_model_they_began_with(transport: str) -> None:
    call = TRANSPORTS[transport]
    old, new = FakeForecaster(), FakeForecaster(version="2.0.0", modes=5)
    shelf = Shelf(old)
    async with serving(shelf) as server:
        old.entered.clear()
        old.free.clear()
        in_model = asyncio.create_task(call(server, make_request(1)))
        assert await asyncio.to_thread(old.entered.wait, 10)
        shelf.forecasters = [new]
        reloading = asyncio.create_task(reload(server, transport))
        await asyncio.sleep(0.05)
        old.free.set()
        response = await reloading
        assert [model.version for model in response.loaded] == ["2.0.0"]
        assert [model.version for model in response.dropped] == ["1.0.0"]
        assert (response.default_model.name, response.default_model.version) == ("fake", "2.0.0")
        assert (await in_model).model.version == "1.0.0"
        assert (await call(server, make_request(1))).model.version == "2.0.0"
        assert reloads(server, "changed") == 1
        again = await reload(server, transport)
        assert [*again.loaded, *again.dropped, *again.refused] == []
        assert reloads(server, "unchanged") == 1


async def test_no_answer_is_lost_or_mixed_while_models_come_and_go() -> None:
    shelf = Shelf(FakeForecaster(modes=4))
    modes = {"1.0.0": 4}
    answered: list[tuple[str, int, int]] = []
    over = asyncio.Event()

    async def keep_calling(server: Server, call: Call, agents: int) -> None:
        while not over.is_set():
            response = await call(server, make_request(agents))
            for forecast in response.forecasts:
                answered.append(
                    (forecast.model.version, len(forecast.weights), len(response.forecasts) - agents)
                )

    async with serving(shelf) as server:
        callers = [
            asyncio.create_task(keep_calling(server, call, agents))
            for call in TRANSPORTS.values()
            for agents in (1, 3)
        ]
        for number in range(2, 6):
            version = f"{number}.0.0"
            modes[version] = 3 + number
            # Two versions at a time, the older of which leaves with the next reload
            shelf.forecasters = [
                *shelf.forecasters[-1:],
                FakeForecaster(version=version, modes=modes[version]),
            ]
            before = len(answered)
            await reload(server)
            await until(lambda before=before: len(answered) > before + 4)  # type: ignore[misc]
        pinned = [await call_grpc(server, make_request(1, model=f"fake@{number}.0.0")) for number in (4, 5)]
        assert [len(response.forecasts[0].weights) for response in pinned] == [7, 8]
        over.set()
        await asyncio.gather(*callers)  # a call that failed would raise here
    assert {version for version, _, _ in answered} == set(modes)
    assert all(count == modes[version] and missing == 0 for version, count, missing in answered)


async def test_a_model_that_is_dropped_is_freed() -> None:
    shelf = Shelf(FakeForecaster())
    async with serving(shelf) as server:
        await call_grpc(server, make_request(2))
        gc.collect()
        gc.freeze()  # as the server does once it is ready: cycles of what exists by then are never collected
        gc.disable()
        try:
            gone = weakref.ref(shelf.forecasters[0])
            shelf.forecasters = [FakeForecaster(version="2.0.0")]
            await reload(server)
            await call_grpc(server, make_request(2))
            await until(lambda: gone() is None)
        finally:
            gc.enable()
            gc.unfreeze()


async def test_networks_are_freed_and_the_broken_are_refused(tmp_path: Path) -> None:
    copy_bundled(tmp_path / "one", SMALL, "2.0.0")
    server = Server(settings(models=tmp_path, default_model=SMALL, max_batch_agents=4))
    await server.start()
    try:
        gc.collect()
        gc.freeze()
        gc.disable()
        gone = weakref.ref(server.dataplane._pipeline.catalog.default)
        (tmp_path / "lost+found").mkdir()
        copy_bundled(tmp_path / "two", SMALL, "2.1.0")
        (tmp_path / "two" / "model.safetensors").write_bytes(b"half a fi")
        with capture_logs() as logs:
            response = await reload(server)
        (refused,) = response.refused
        assert refused.folder == "two"
        assert "model.safetensors: not a whole safetensors file" in refused.reason
        assert any(entry.get("reason") == refused.reason for entry in logs)
        assert reloads(server, "refused") == 1
        assert (await call_grpc(server, make_request(1))).model.version == "2.0.0"
        shutil.rmtree(tmp_path / "two")
        shutil.rmtree(tmp_path / "one")
        copy_bundled(tmp_path / "two", SMALL, "2.1.0")
        response = await reload(server, "rest")
        assert [model.version for model in response.loaded] == ["2.1.0"]
        assert (await call_grpc(server, make_request(1))).model.version == "2.1.0"
        await until(lambda: gone() is None)
        shutil.rmtree(tmp_path / "two")
        for transport in TRANSPORTS:
            with pytest.raises(ForecastError, match=f"default_model: there is no model '{SMALL}'") as caught:
                await reload(server, transport)
            assert (caught.value.code, caught.value.reason) == ("FAILED_PRECONDITION", "RELOAD_REFUSED")
        assert (await call_grpc(server, make_request(1))).model.version == "2.1.0"
    finally:
        gc.enable()
        gc.unfreeze()
        await server.stop()


async def test_a_failing_warm_up_changes_nothing() -> None:
    shelf = Shelf(FakeForecaster())
    async with serving(shelf) as server:
        broken = FakeForecaster(version="2.0.0")
        broken.broken = True
        shelf.forecasters = [broken]
        with pytest.raises(ForecastError, match="warm-up failed: secret of the model"):
            await reload(server)
        assert (await call_grpc(server, make_request(1))).model.version == "1.0.0"


async def test_sighup_reloads() -> None:
    shelf = Shelf(FakeForecaster())
    server = Server(settings(default_model="fake", max_batch_agents=4), load=shelf)
    ready = threading.Event()
    serving = asyncio.create_task(server.run(lambda _: ready.set()))
    assert await asyncio.to_thread(ready.wait, 30)
    shelf.forecasters = [FakeForecaster(version="2.0.0")]
    os.kill(os.getpid(), signal.SIGHUP)
    await until(lambda: reloads(server, "changed") == 1)
    assert (await call_grpc(server, make_request(1))).model.version == "2.0.0"
    shelf.forecasters = []
    with capture_logs() as logs:
        os.kill(os.getpid(), signal.SIGHUP)
        await until(lambda: reloads(server, "refused") == 1)
    assert any("default_model" in entry.get("reason", "") for entry in logs)
    assert (await call_grpc(server, make_request(1))).model.version == "2.0.0"
    os.kill(os.getpid(), signal.SIGTERM)
    await serving


async def test_a_folder_that_is_watched(tmp_path: Path) -> None:
    copy_bundled(tmp_path / "one", SMALL, "2.0.0")
    values = settings(models=tmp_path, default_model=SMALL, max_batch_agents=4, reload_seconds=0.1)
    server = Server(values)
    await server.start()
    try:
        copy_bundled(tmp_path / "two", SMALL, "2.1.0")
        await until(lambda: reloads(server, "changed") == 1)
        assert (await call_grpc(server, make_request(1))).model.version == "2.1.0"
        (tmp_path / "two" / "config.json").write_text("{}")
        await until(lambda: reloads(server, "refused") == 1)
        assert (await call_grpc(server, make_request(1))).model.version == "2.1.0"
    finally:
        await server.stop()


async def test_who_may_reload() -> None:
    everywhere = {"http": "0.0.0.0:0", "grpc": "0.0.0.0:0", "max_batch_agents": 2}
    async with running(allow_anyone=True, **everywhere) as server:
        for transport in TRANSPORTS:
            with pytest.raises(PermissionDenied):
                await reload(server, transport)
    async with running(api_tokens=("t",), **everywhere) as server:
        for transport in TRANSPORTS:
            with pytest.raises(Unauthenticated) as caught:
                await reload(server, transport)
            assert caught.value.code == "UNAUTHENTICATED"
            async with AsyncClient(address(server, transport), "t") as client:
                assert (await client.reload_models()).default_model.name == "kalman"


async def test_default_models_of_callers() -> None:
    fake, other = FakeForecaster(), FakeForecaster("other")
    async with running(fake, other, default_models="truck=other,bus=fake@1.0", max_batch_agents=2) as server:
        found = {}
        for caller in ("truck", "bus", "somebody", None):
            with server.dataplane.accept() as call:
                call.caller = caller
                found[caller] = (await server.dataplane.predict(make_request(1), call)).model.name
        assert found == {"truck": "other", "bus": "fake", "somebody": "fake", None: "fake"}
