"""Exported metrics."""

from collections.abc import Mapping
from importlib import metadata

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from cab.forecast.v1.routes import ROUTES
from model.baselines import kalman
from model.forecaster import ModelInfo, Protocol
from service.server import Server
from service.telemetry.metrics import Metrics
from tests.service.fakes import FakeForecaster
from tests.service.requests import CYCLIST, add_agent, make_request
from tests.service.servers import CallError, call_grpc, call_rest, running


async def scrape(
    server: Server, headers: Mapping[str, str] | None = None
) -> dict[tuple[str, frozenset[str]], float]:
    async with httpx.AsyncClient() as client:
        text = (await client.get(f"http://{server.http_address}/metrics", headers=headers)).text
    return {
        (sample.name, frozenset(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


async def test_calls_are_counted() -> None:
    async with running(FakeForecaster()) as server:
        request = make_request(2)
        add_agent(request, "bike", CYCLIST)
        request.agents[1].states[0].x = float("nan")
        await call_grpc(server, request)
        await call_rest(server, make_request(1))
        with pytest.raises(CallError):
            await call_rest(server, make_request(1, model="nobody"))
        seen = await scrape(server)
    assert seen["forecast_requests_total", frozenset({"grpc", "Predict", "OK"})] == 1
    assert seen["forecast_requests_total", frozenset({"rest", "Predict", "OK"})] == 1
    assert seen["forecast_requests_total", frozenset({"rest", "Predict", "NOT_FOUND"})] == 1
    assert seen["forecast_request_duration_seconds_count", frozenset({"rest", "Predict"})] == 2
    assert seen["forecast_agents_total", frozenset({"fake", "ok"})] == 2
    assert seen["forecast_agents_total", frozenset({"fake", "invalid"})] == 1
    assert seen["forecast_agents_total", frozenset({"fake", "fallback"})] == 1
    assert seen["forecast_batch_agents_sum", frozenset()] == 3
    assert seen["forecast_queue_seconds_count", frozenset()] == 3
    assert seen["forecast_inference_seconds_count", frozenset({"fake"})] == 2
    assert seen["forecast_inference_seconds_count", frozenset({"constant-velocity-yaw"})] == 1
    assert seen["forecast_queue_agents", frozenset()] == 0
    assert seen["forecast_model_info", frozenset({"fake", "1.0.0", "causal", "true"})] == 1
    assert seen["forecast_model_info", frozenset({"kalman", "1.0.0", "causal", "false"})] == 1
    assert ("process_cpu_seconds_total", frozenset()) in seen


async def test_no_ids_in_labels() -> None:
    async with running() as server:
        request = make_request(1)
        request.scene_id = "secret-scene"
        request.agents[0].id = "secret-agent"
        await call_grpc(server, request)
        with pytest.raises(CallError):
            await call_grpc(server, make_request(1, model="secret-model"))
        assert "secret" not in server.metrics.render().decode()


async def test_servers_do_not_share_metrics() -> None:
    async with running() as one, running() as other:
        await call_grpc(one, make_request(1))
        name, labels = "forecast_requests_total", {"transport": "grpc", "method": "Predict", "code": "OK"}
        assert one.metrics.registry.get_sample_value(name, labels) == 1
        assert other.metrics.registry.get_sample_value(name, labels) == 0


def test_the_benchmark_is_of_the_version_that_a_name_means() -> None:
    metrics = Metrics()

    def info(name: str, version: str, error_m: float, protocol: Protocol = Protocol.CAUSAL) -> ModelInfo:
        made = FakeForecaster(name, version=version, protocol=protocol).info
        return made.model_copy(update={"benchmark": {"fde_ml_1s_m": 0.5, "fde_ml_6s_m": error_m, "nll": 9.0}})

    default = info("cab", "1.0.0", 9.0)
    metrics.set_models(
        [
            default,
            info("cab", "1.1.0", 8.0),
            info("rubiz", "1.0.0", 12.0),
            info("rubiz", "1.1.0", 11.0),
            info("rubiz", "1.2.0", 7.0, Protocol.PAPER),
            info("reweight", "1.0.0", 6.0, Protocol.PAPER),
            kalman.Kalman().info,
        ],
        default,
    )
    families = text_string_to_metric_families(metrics.render().decode())
    [gauge] = [f for f in families if f.name == "forecast_benchmark_displacement_error_meters"]
    seen = {(sample.labels["model"], sample.labels["horizon"]): sample.value for sample in gauge.samples}
    names = {"cab": 9.0, "rubiz": 11.0, "reweight": 6.0}
    assert seen == {(name, "6"): m for name, m in names.items()} | {(name, "1"): 0.5 for name in names}


def test_what_never_happened_is_counted_as_0() -> None:
    metrics = Metrics()
    fake = FakeForecaster().info
    metrics.set_models([fake], fake)
    assert metrics.registry.get_sample_value("forecast_nonfinite_total", {"model": "fake"}) == 0


async def test_calls_are_counted_from_0_for_each_code() -> None:
    async with running(FakeForecaster()) as server:
        families = text_string_to_metric_families(server.metrics.render().decode())
    [requests] = [family for family in families if family.name == "forecast_requests"]
    totals = {
        (sample.labels["transport"], sample.labels["method"], sample.labels["code"]): sample.value
        for sample in requests.samples
        if sample.name == "forecast_requests_total"
    }
    assert set(totals.values()) == {0.0}
    assert {(transport, method) for transport, method, _ in totals} == {
        (transport, route.method) for transport in ("grpc", "rest") for route in ROUTES
    }
    for transport in ("grpc", "rest"):
        assert {code for *call, code in totals if call == [transport, "Predict"]} == {
            "OK",
            "CANCELLED",
            "DEADLINE_EXCEEDED",
            "FAILED_PRECONDITION",
            "INTERNAL",
            "INVALID_ARGUMENT",
            "NOT_FOUND",
            "PERMISSION_DENIED",
            "RESOURCE_EXHAUSTED",
            "UNAUTHENTICATED",
            "UNAVAILABLE",
        }
    assert ("rest", "ListModels", "NOT_FOUND") not in totals


async def test_agents_keys_and_store_errors_are_counted_from_0() -> None:
    async with running(FakeForecaster(), api_tokens=("right",)) as server:
        seen = await scrape(server, {"authorization": "Bearer right"})
    for status in ("ok", "short_history", "fallback", "invalid"):
        assert seen["forecast_agents_total", frozenset({"fake", status})] == 0
    assert seen["forecast_off_road_total", frozenset({"fake"})] == 0
    assert seen["forecast_key_requests_total", frozenset({"(api_tokens)", "INTERNAL"})] == 0
    assert seen["forecast_track_store_errors_total", frozenset({"exchange", "timeout"})] == 0


async def test_the_build_is_told() -> None:
    async with running(revision="abc123") as server:
        [family] = [
            family
            for family in text_string_to_metric_families(server.metrics.render().decode())
            if family.name == "forecast_build_info"
        ]
    [sample] = family.samples
    assert sample.value == 1
    assert sample.labels["version"] == metadata.version("cab-forecast")
    assert sample.labels["revision"] == "abc123"
    assert sample.labels["torch"] == metadata.version("torch")
