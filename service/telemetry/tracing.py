"""Traces by OpenTelemetry: one span a call, and spans of its stages below it.

Where tracing is off, a span costs one look at a context variable. OpenTelemetry's SDK comes with the extra
"tracing", and is imported only where tracing is on.
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import TYPE_CHECKING

import structlog

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import SpanExporter
    from opentelemetry.trace import Span, Tracer

INSTALL = 'pip install "cab-forecast[tracing]"'
"""Command that installs what tracing needs."""
_SERVICE = "cab-forecast"
_FAULTS = frozenset(("INTERNAL", "UNAVAILABLE", "DEADLINE_EXCEEDED"))
"""Codes that mark a span as failed: as OpenTelemetry has it, faults of the caller do not."""
_NO_SPAN: AbstractContextManager[object] = nullcontext()
_TRACER: "ContextVar[Tracer | None]" = ContextVar("tracer", default=None)


class TracingMissingError(Exception):
    """Error of a server without the packages for tracing; the text says how to install them."""


class CallSpan:
    """Span of one call."""

    def __init__(self) -> None:
        self.trace_id = ""
        """Id of the trace if it is sampled, 32 hexadecimal digits; else empty."""
        self.code = "CANCELLED"
        """Canonical status code, to be set before the call ends."""


class Tracing:
    """Tracer of one server."""

    def __init__(self, provider: "TracerProvider") -> None:
        self._provider = provider
        self._tracer = provider.get_tracer(_SERVICE)

    @contextmanager
    def call(
        self, transport: str, method: str, request_id: str, carrier: Mapping[str, str]
    ) -> Iterator[CallSpan]:
        """Trace a call, below the caller's span if there is one.

        Args:
            transport: "grpc" or "rest".
            method: name of the contract's method.
            request_id: id of the request.
            carrier: ``traceparent`` and ``tracestate`` of the caller, if any.
        """
        from opentelemetry.trace import SpanKind, StatusCode  # noqa: PLC0415
        from opentelemetry.trace.propagation.tracecontext import (  # noqa: PLC0415
            TraceContextTextMapPropagator,
        )

        told = CallSpan()
        with self._tracer.start_as_current_span(
            method,
            TraceContextTextMapPropagator().extract(carrier),
            kind=SpanKind.SERVER,
            attributes={
                "rpc.system": transport,
                "rpc.method": method,
                "forecast.request_id": request_id,
            },
            record_exception=False,  # it may quote what the client sent
            set_status_on_exception=False,
        ) as span:
            context = span.get_span_context()
            trace_id = f"{context.trace_id:032x}"
            structlog.contextvars.bind_contextvars(trace_id=trace_id)
            told.trace_id = trace_id if context.trace_flags.sampled else ""
            token = _TRACER.set(self._tracer)
            try:
                yield told
            finally:
                _TRACER.reset(token)
                span.set_attribute("forecast.code", told.code)
                if told.code in _FAULTS:
                    span.set_status(StatusCode.ERROR, told.code)

    def close(self) -> None:
        """Send the spans that are left, and stop."""
        self._provider.shutdown()


def make_tracing() -> Tracing:
    """Return a tracer that sends its spans by OTLP over gRPC, as the standard OTEL_* variables say.

    Raises:
        TracingMissingError: the packages are not installed.
    """
    try:
        from opentelemetry.sdk.resources import SERVICE_NAME, Resource  # noqa: PLC0415
        from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415
        from opentelemetry.sdk.trace.export import BatchSpanProcessor  # noqa: PLC0415

        exporter = make_exporter()
    except ImportError as error:
        raise TracingMissingError(f"traces need packages that are not installed: {INSTALL}") from error
    resource = Resource.create()
    if str(resource.attributes[SERVICE_NAME]).startswith("unknown_service"):  # no variable names it
        resource = resource.merge(Resource({SERVICE_NAME: _SERVICE}))
    provider = TracerProvider(resource=resource, shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(exporter))
    return Tracing(provider)


def make_exporter() -> "SpanExporter":
    """Return the exporter of spans.

    Raises:
        ImportError: it is not installed.
    """
    from opentelemetry.exporter.otlp.proto.grpc.trace_exporter import OTLPSpanExporter  # noqa: PLC0415

    return OTLPSpanExporter()


def span(name: str, **attributes: str | int) -> AbstractContextManager[object]:
    """Return a context that is a span of the current call; it does nothing where calls are not traced."""
    tracer = _TRACER.get()
    if tracer is None:
        return _NO_SPAN
    return tracer.start_as_current_span(
        name, attributes=attributes, record_exception=False, set_status_on_exception=False
    )


def past_span(
    name: str, begun: float, ended: float, parent: "Span | None" = None, **attributes: str | int
) -> "Span | None":
    """Add a span of the current call that lies in the past, if calls are traced, and return it.

    Args:
        name: name of the span.
        begun: its start, by ``time.perf_counter``.
        ended: its end, by ``time.perf_counter``.
        parent: span of which it is a part; None: that of the call.
        attributes: its attributes.
    """
    tracer = _TRACER.get()
    if tracer is None:
        return None
    from opentelemetry.trace import set_span_in_context  # noqa: PLC0415

    offset = time.time_ns() - time.perf_counter_ns()
    within = None if parent is None else set_span_in_context(parent)
    made = tracer.start_span(name, within, attributes=attributes, start_time=round(begun * 1e9) + offset)
    made.end(round(ended * 1e9) + offset)
    return made
