"""Errors as google.rpc.Status with details; the counterpart of REST's problem documents."""

import functools
from collections.abc import Sequence

import grpc
from google.protobuf import any_pb2, duration_pb2
from google.protobuf.message import Message
from google.rpc import error_details_pb2, status_pb2

from service.errors import DOMAIN, Fault, ServiceError
from service.telemetry.request_ids import HEADER, current_request_id

DETAILS_KEY = "grpc-status-details-bin"
"""Key of the trailing metadata that carries the status."""
_MAX_VIOLATION_BYTES = 4096
"""Encoded size at which the list of violations ends. gRPC limits metadata to 8 KiB by default, and the first
few dozen violations are enough to find the cause."""
_MAX_TEXT = 200
"""Characters; longer texts are cut, because they may quote what the client sent."""


def to_status(error: ServiceError) -> status_pb2.Status:
    """Return the status of an error: always with ErrorInfo, with RequestInfo in a request, with BadRequest if
    fields are wrong, and with RetryInfo if a retry may succeed."""
    details = [_info(error.reason)]
    request_id = current_request_id()
    if request_id:
        details.append(_pack(error_details_pb2.RequestInfo(request_id=request_id)))
    if error.faults:
        details.append(_pack(_bad_request(error.faults)))
    if error.retry_after is not None:
        delay = duration_pb2.Duration()
        delay.FromNanoseconds(round(error.retry_after * 1e9))
        details.append(_pack(error_details_pb2.RetryInfo(retry_delay=delay)))
    code: int = grpc.StatusCode[error.code].value[0]
    return status_pb2.Status(code=code, message=error.detail[:_MAX_TEXT], details=details)


async def abort(context: "grpc.aio.ServicerContext[object, object]", error: ServiceError) -> None:
    """End a call with an error. Raises, as ``context.abort`` does."""
    status = to_status(error)
    metadata = ((DETAILS_KEY, status.SerializeToString()), (HEADER, current_request_id()))
    await context.abort(grpc.StatusCode[error.code], status.message, metadata)


@functools.cache
def _info(reason: str) -> any_pb2.Any:
    """Return the ErrorInfo of a reason, made once: under overload most calls end with the same one."""
    return _pack(error_details_pb2.ErrorInfo(reason=reason, domain=DOMAIN))


def _bad_request(faults: Sequence[Fault]) -> error_details_pb2.BadRequest:
    """Return as many of the faults as there is room for, at least one."""
    message = error_details_pb2.BadRequest()
    for fault in faults:
        message.field_violations.add(field=fault.field[:_MAX_TEXT], description=fault.detail[:_MAX_TEXT])
        if message.ByteSize() > _MAX_VIOLATION_BYTES:
            break
    return message


def _pack(message: Message) -> any_pb2.Any:
    packed = any_pb2.Any()
    packed.Pack(message)
    return packed
