"""Parts of a call that both transports share: accounting, error mapping, and the methods to execute."""

from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import structlog
from google.protobuf.message import DecodeError, Message

from cab.forecast.v1.routes import (
    GET_AGENT_CONSISTENCY,
    GET_MODEL,
    GET_SCENE_CONSISTENCY,
    LIST_MODEL_CONSISTENCY,
    LIST_MODELS,
    RELOAD_MODELS,
    RESET_SCENE,
    Route,
)
from service.access.caller import Caller
from service.errors import BadField, Internal, ServiceError
from service.predict.dataplane import DataPlane
from service.telemetry.metrics import Call, Metrics

_log = structlog.get_logger(__name__)
_Message = TypeVar("_Message", bound=Message)


UNARY_METHODS: Mapping[Route[Any, Any], Callable[[DataPlane, Any], Awaitable[Message]]] = {
    LIST_MODELS: lambda dataplane, request: dataplane.list_models(request),
    GET_MODEL: lambda dataplane, request: dataplane.get_model(request),
    GET_AGENT_CONSISTENCY: lambda dataplane, request: dataplane.consistency.get_agent(request),
    GET_SCENE_CONSISTENCY: lambda dataplane, request: dataplane.consistency.get_scene(request),
    LIST_MODEL_CONSISTENCY: lambda dataplane, request: dataplane.consistency.list_models(request),
    RESET_SCENE: lambda dataplane, request: dataplane.consistency.reset_scene(request),
    RELOAD_MODELS: lambda dataplane, request: dataplane.reload_models(request),
}
"""Functions that execute the unary methods except Predict, whose requests are decoded off the event loop."""


class CallRecorder:
    """Recorder of how one call ended, for the metrics and the debug log."""

    def __init__(self, transport: str, method: str, call: Call) -> None:
        self._transport = transport
        self._method = method
        self._call = call

    def identified(self, caller: Caller) -> None:
        """Record whose call it is."""
        self._call.key = caller.name

    def succeeded(self) -> None:
        """Record a call that was answered."""
        self._call.code = "OK"
        self._debug()

    def failed(self, exception: Exception) -> ServiceError:
        """Record a failed call; return the error to respond with."""
        error = to_service_error(exception, self._method)
        self._call.code = error.code
        self._debug(reason=error.reason)
        return error

    def cancelled(self) -> None:
        """Record that the client disconnected first; the code is CANCELLED already."""
        self._debug()

    def _debug(self, **fields: str) -> None:
        _log.debug("call", transport=self._transport, method=self._method, code=self._call.code, **fields)


@contextmanager
def record_call(
    metrics: Metrics, transport: str, method: str, *, timed: bool = True
) -> Iterator[CallRecorder]:
    """Count and time a call.

    Args:
        metrics: receives the count and the duration.
        transport: "grpc" or "rest".
        method: name of the contract's method.
        timed: False for streams, whose duration is up to the client.
    """
    with metrics.call(transport, method, timed) as call:
        yield CallRecorder(transport, method, call)


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
