"""Traces of calls on both transports, and the exemplars that lead to them."""

import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

import httpx
import pytest
import structlog
from prometheus_client.openmetrics.parser import text_string_to_metric_families
from structlog.testing import capture_logs

from service.server import Server, StartError
from tests.service.fakes import FakeForecaster
from tests.service.requests import make_request
from tests.service.servers import TRANSPORTS, CallError, running, settings

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import ReadableSpan
    from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"
PARENT = "00f067aa0ba902b7"
TRACEPARENT = f"00-{TRACE}-{PARENT}-01"


@pytest.fixture
def exporter(monkeypatch: pytest.MonkeyPatch) -> "Iterator[InMemorySpanExporter]":
    """Keep the spans in memory."""
    memory = pytest.importorskip(
        "opentelemetry.sdk.trace.export.in_memory_span_exporter",
        reason='tracing needs pip install "cab-forecast[tracing]"',
    )
    exporter = memory.InMemorySpanExporter()
    monkeypatch.setattr("service.telemetry.tracing.make_exporter", lambda: exporter)
    yield exporter
    exporter.clear()


def by_name(exporter: "InMemorySpanExporter") -> "dict[str, ReadableSpan]":
    spans = exporter.get_finished_spans()
    named = {span.name: span for span in spans}
    assert len(named) == len(spans)
    return named


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_a_call_has_spans_for_its_stages(transport: str, exporter: "InMemorySpanExporter") -> None:
    request = make_request(2)
    request.scene_id = "s"
    async with running(FakeForecaster(), tracing=True) as server:
        sent = {"traceparent": TRACEPARENT, "tracestate": "vendor=1", "x-request-id": "tick-17"}
        with capture_logs(processors=[structlog.contextvars.merge_contextvars]) as logs:
            await TRANSPORTS[transport](server, request, sent)
    spans = by_name(exporter)
    stages = {"decode", "turn", "plan", "queue", "forward", "memory", "encode"}
    parts = {"patches", "network"}
    assert set(spans) == {"Predict"} | stages | parts
    call = spans["Predict"]
    assert call.parent is not None
    assert (f"{call.context.trace_id:032x}", f"{call.parent.span_id:016x}") == (TRACE, PARENT)
    assert call.context.trace_state.get("vendor") == "1"
    attributes = dict(call.attributes or {})
    assert attributes["rpc.system"] == transport
    assert attributes["forecast.request_id"] == "tick-17"
    assert attributes["forecast.code"] == "OK"
    assert call.start_time is not None
    assert call.end_time is not None
    for name in stages | parts:
        span = spans[name]
        above = spans["forward"] if name in parts else call
        assert span.parent is not None
        assert span.parent.span_id == above.context.span_id
        assert span.start_time is not None
        assert span.end_time is not None
        # The clock that stages in the past are converted by is read once more, a little later
        assert call.start_time - 10**7 <= span.start_time <= span.end_time <= call.end_time + 10**7
    # The parts make up the whole; clocks are converted for each span
    ends = [spans[name].end_time for name in ("patches", "network", "forward")]
    starts = [spans[name].start_time for name in ("network", "patches", "forward")]
    for one, other in ((ends[0], starts[0]), (ends[1], ends[2]), (starts[1], starts[2])):
        assert abs((one or 0) - (other or 0)) < 10**6
    forward = dict(spans["forward"].attributes or {})
    assert forward == {"model": "fake@1.0.0", "agents": 2, "batch_agents": 2}
    assert [entry["trace_id"] for entry in logs if entry["event"] == "call"] == [TRACE]


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_a_failed_call_is_marked(transport: str, exporter: "InMemorySpanExporter") -> None:
    fake = FakeForecaster()
    async with running(fake, tracing=True) as server:
        fake.broken = True
        with pytest.raises(CallError):
            await TRANSPORTS[transport](server, make_request())
        with pytest.raises(CallError):
            await TRANSPORTS[transport](server, make_request(model="nobody"))
        fake.broken = False
    calls = [span for span in exporter.get_finished_spans() if span.name == "Predict"]
    told = [((span.attributes or {})["forecast.code"], span.status.is_ok) for span in calls]
    assert told == [("INTERNAL", False), ("NOT_FOUND", True)]
    assert not any(span.events for span in exporter.get_finished_spans())  # none quotes the request


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_durations_have_exemplars(transport: str, exporter: "InMemorySpanExporter") -> None:
    async with running(FakeForecaster(), tracing=True) as server:
        await TRANSPORTS[transport](server, make_request(), {"traceparent": TRACEPARENT})
        async with httpx.AsyncClient() as client:
            url = f"http://{server.http_address}/metrics"
            plain = await client.get(url)
            accept = {"accept": "application/openmetrics-text; version=1.0.0"}
            response = await client.get(url, headers=accept)
    assert plain.headers["content-type"].startswith("text/plain")
    assert TRACE not in plain.text
    assert response.headers["content-type"].startswith("application/openmetrics-text")
    parsed = text_string_to_metric_families(response.text)  # type: ignore[no-untyped-call]
    families = {family.name: family for family in parsed}
    exemplars = [
        sample.exemplar.labels
        for sample in families["forecast_request_duration_seconds"].samples
        if sample.exemplar is not None
    ]
    assert exemplars == [{"trace_id": TRACE}]


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_a_trace_that_the_caller_does_not_sample_is_not_sampled(
    transport: str, exporter: "InMemorySpanExporter"
) -> None:
    async with running(FakeForecaster(), tracing=True) as server:
        unsampled = {"traceparent": f"00-{TRACE}-{PARENT}-00"}
        await TRANSPORTS[transport](server, make_request(), unsampled)
    assert exporter.get_finished_spans() == ()


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_nothing_is_traced_by_default(transport: str, exporter: "InMemorySpanExporter") -> None:
    async with running(FakeForecaster()) as server:
        await TRANSPORTS[transport](server, make_request(), {"traceparent": TRACEPARENT})
    assert exporter.get_finished_spans() == ()


async def test_a_server_without_the_packages_says_how_to_get_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.exporter.otlp.proto.grpc.trace_exporter", None)
    with pytest.raises(StartError, match=r'tracing: .* pip install "cab-forecast\[tracing\]"'):
        Server(settings(tracing=True))
