"""Parts of a call that both transports share: accounting, error mapping, and the methods to execute."""

import zlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from time import perf_counter
from typing import Any, TypeVar

import structlog
from google.protobuf.message import DecodeError, Message

from cab.forecast.v1.routes import (
    GET_AGENT_CONSISTENCY,
    GET_MODEL,
    GET_SCENE_CONSISTENCY,
    GET_VERSION,
    LIST_MODEL_CONSISTENCY,
    LIST_MODELS,
    LIST_SCENES,
    RELOAD_MODELS,
    RESET_SCENE,
    ROUTES,
    WATCH_FORECASTS,
    WATCH_SCENE,
    Route,
)
from service.access.caller import Caller
from service.errors import BadField, Internal, ServiceError
from service.predict.dataplane import DataPlane
from service.settings import Settings
from service.telemetry.metrics import Call, Metrics
from service.telemetry.request_ids import current_carrier, current_request_id
from service.telemetry.tracing import Tracing
from service.transports.method_errors import codes
from service.transports.streams import Event

_log = structlog.get_logger(__name__)
_Message = TypeVar("_Message", bound=Message)


UNARY_METHODS: Mapping[Route[Any, Any], Callable[[DataPlane, Any, str | None], Awaitable[Message]]] = {
    LIST_MODELS: lambda dataplane, request, caller: dataplane.list_models(request, caller),
    GET_MODEL: lambda dataplane, request, caller: dataplane.get_model(request, caller),
    GET_VERSION: lambda dataplane, request, _: dataplane.get_version(request),
    GET_AGENT_CONSISTENCY: lambda dataplane, request, _: dataplane.consistency.get_agent(request),
    GET_SCENE_CONSISTENCY: lambda dataplane, request, _: dataplane.consistency.get_scene(request),
    LIST_MODEL_CONSISTENCY: lambda dataplane, request, _: dataplane.consistency.list_models(request),
    RESET_SCENE: lambda dataplane, request, _: dataplane.consistency.reset_scene(request),
    LIST_SCENES: lambda dataplane, request, _: dataplane.scenes.list_scenes(request),
    RELOAD_MODELS: lambda dataplane, request, _: dataplane.reload_models(request),
}
"""Functions that execute the unary methods, of data plane, request and the name of the caller's key; except
Predict and Explain, whose requests are decoded off the event loop."""

STREAMS: Mapping[Route[Any, Any], Callable[[DataPlane, Any], AsyncIterator[Event]]] = {
    WATCH_SCENE: lambda dataplane, request: dataplane.consistency.watch_scene(request),
    WATCH_FORECASTS: lambda dataplane, request: dataplane.scenes.watch_forecasts(request),
}
"""Functions that open the streams of events."""


class CallRecorder:
    """Recorder of how one call ended."""

    def __init__(self, transport: str, method: str, call: Call, logged_share: float) -> None:
        self._transport = transport
        self._method = method
        self._call = call
        self._share = logged_share
        self._started = perf_counter()
        self._ended = False

    def identified(self, caller: Caller) -> None:
        """Record whose call it is."""
        self._call.key = caller.name

    def succeeded(self) -> None:
        """Record a call that was answered."""
        self._call.code = "OK"
        self._log()

    def failed(self, exception: Exception) -> ServiceError:
        """Record a failed call; return the error to respond with."""
        error = to_service_error(exception, self._method)
        self._call.code = error.code
        self._log(reason=error.reason)
        return error

    def end(self) -> None:
        """Record that the client disconnected first, unless the call has succeeded or failed."""
        if not self._ended:
            self._log()

    def _log(self, **fields: str) -> None:
        # Written before the error is sent: after that, a line would keep the call in progress
        self._ended = True
        if self._call.key:
            fields["key"] = self._call.key
        log = _log.info if _is_sampled(current_request_id(), self._share) else _log.debug
        seconds = round(perf_counter() - self._started, 6)
        log(
            "call",
            transport=self._transport,
            method=self._method,
            code=self._call.code,
            seconds=seconds,
            **fields,
        )


class CallRecords:
    """Records of all calls of one transport: counts, durations and the access log."""

    def __init__(
        self, transport: str, metrics: Metrics, settings: Settings, tracing: Tracing | None = None
    ) -> None:
        """
        Args:
            transport: "grpc" or "rest".
            metrics: receives counts and durations.
            settings: say which share of the calls is logged.
            tracing: traces the calls; None: they are not traced.
        """
        self._transport = transport
        self._metrics = metrics
        self._share = settings.access_log
        self._tracing = tracing
        for route in ROUTES:
            metrics.begin_calls(transport, route.method, codes(transport, route))

    @contextmanager
    def record(self, method: str, *, timed: bool = True) -> Iterator[CallRecorder]:
        """Count, time and log a call; it counts as cancelled by the client unless the recorder is told more.

        Args:
            method: name of the contract's method.
            timed: False for streams, whose duration is up to the client.
        """
        with self._metrics.call(self._transport, method, timed) as call, self._traced(method, call):
            recorder = CallRecorder(self._transport, method, call, self._share)
            try:
                yield recorder
            finally:
                recorder.end()

    @contextmanager
    def _traced(self, method: str, call: Call) -> Iterator[None]:
        if self._tracing is None:
            yield
            return
        with self._tracing.call(self._transport, method, current_request_id(), current_carrier()) as span:
            call.trace_id = span.trace_id
            try:
                yield
            finally:
                span.code = call.code


def _is_sampled(request_id: str, share: float) -> bool:
    """Return whether a call is logged at info; this is the same on all servers, and when it is retried."""
    return zlib.crc32(request_id.encode()) < share * 2**32


def to_service_error(error: Exception, method: str) -> ServiceError:
    """Return the error to respond with for any exception.

    Unexpected exceptions become INTERNAL; details go to the log only.

    Args:
        error: what the call raised.
        method: name of the contract's method, for the log.
    """
    if isinstance(error, ServiceError):
        return error
    _log.error("unexpected error", method=method, exc_info=error)
    return Internal()


def parse_message(message_type: type[_Message], body: bytes) -> _Message:
    """Parse a small protobuf message.

    Raises:
        BadField: the body is not a valid message of that type.
    """
    try:
        return message_type.FromString(body)
    except DecodeError as error:
        raise BadField("body", f"is not a valid {message_type.DESCRIPTOR.full_name}") from error
