"""Errors as problem+json (RFC 9457); the counterpart of gRPC's status details."""

import math
from typing import Any

import orjson
from starlette.responses import Response

from service.errors import ServiceError, Unauthenticated
from service.telemetry.request_ids import current_request_id

MEDIA_TYPE = "application/problem+json"


def to_problem(error: ServiceError) -> dict[str, Any]:
    """Return the problem document of an error."""
    request_id = current_request_id()
    return {
        "type": error.type_uri(),
        "title": error.title,
        "status": error.http_status,
        "detail": error.detail,
        "code": error.code,
        "reason": error.reason,
        "errors": [{"field": fault.field, "detail": fault.detail} for fault in error.faults],
        **({"request_id": request_id} if request_id else {}),
    }


def problem_response(error: ServiceError, headers: dict[str, str] | None = None) -> Response:
    """Return the HTTP response for an error.

    Args:
        error: the error.
        headers: additional headers.
    """
    headers = dict(headers or {})
    if error.retry_after is not None:
        headers["Retry-After"] = str(max(1, math.ceil(error.retry_after)))  # whole seconds, by RFC 9110
    if isinstance(error, Unauthenticated):
        headers.setdefault("WWW-Authenticate", "Bearer")
    return Response(
        orjson.dumps(to_problem(error)), status_code=error.http_status, media_type=MEDIA_TYPE, headers=headers
    )
