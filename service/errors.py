# ruff: noqa: N818 - rows of a table of errors, named as the contract names them
"""Errors of calls: one table for both transports.

Each class is a row of the table. gRPC encodes it as google.rpc.Status with details, REST as problem+json
(RFC 9457). This module depends on neither.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from cab.forecast.v1.bounds import MAX_ID_LENGTH

DOMAIN = "cab-forecast"
"""Domain of google.rpc.ErrorInfo, and the namespace of the problem types."""


@dataclass(frozen=True)
class Fault:
    """An invalid field of a request, and why it is invalid."""

    field: str
    """Path in the request, e.g. "agents[3].states[1].x"."""
    detail: str


def id_too_long(an_id: str) -> str:
    """Return the detail of the fault of an id that is longer than the contract allows."""
    return f"has {len(an_id)} characters; at most {MAX_ID_LENGTH}"


class ServiceError(Exception):
    """Error of a call; its text is sent to the caller."""

    code: ClassVar[str] = "INTERNAL"
    """Name of the gRPC status code."""
    http_status: ClassVar[int] = 500
    reason: ClassVar[str] = "INTERNAL"
    """Machine-readable reason, UPPER_SNAKE; distinguishes rows of the same code."""
    title: ClassVar[str] = "Internal error"

    def __init__(
        self, detail: str, *, faults: Sequence[Fault] = (), retry_after: float | None = None
    ) -> None:
        """
        Args:
            detail: the text for the caller.
            faults: the invalid fields.
            retry_after: seconds until a retry makes sense; None: do not retry.
        """
        super().__init__(detail)
        self.detail = detail
        self.faults = tuple(faults)
        self.retry_after = retry_after

    @classmethod
    def type_uri(cls) -> str:
        """Return the URI of the problem type."""
        return f"urn:{DOMAIN}:error:{cls.reason.lower().replace('_', '-')}"


class BadFields(ServiceError):
    """Error of a request with invalid fields."""

    code = "INVALID_ARGUMENT"
    http_status = 422
    reason = "BAD_FIELD"
    title = "Bad field"

    def __init__(self, faults: Sequence[Fault]) -> None:
        first = faults[0]
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        super().__init__(f"{first.field}: {first.detail}{more}", faults=faults)


class BadField(BadFields):
    """Error of a request with one invalid field."""

    def __init__(self, field: str, detail: str) -> None:
        super().__init__([Fault(field, detail)])


class Unauthenticated(ServiceError):
    """Error of a call with missing or wrong credentials."""

    code = "UNAUTHENTICATED"
    http_status = 401
    reason = "UNAUTHENTICATED"
    title = "Credentials missing or wrong"


class PermissionDenied(ServiceError):
    """Error of a call that the caller's key does not permit."""

    code = "PERMISSION_DENIED"
    http_status = 403
    reason = "MISSING_SCOPE"
    title = "Not permitted"


class ReloadRefused(ServiceError):
    """Error of a reload after which the server could not answer all its calls; nothing has changed."""

    code = "FAILED_PRECONDITION"
    http_status = 409
    reason = "RELOAD_REFUSED"
    title = "Reload refused"


class LimitExceeded(ServiceError):
    """Error of a call beyond a limit of the caller's key."""

    code = "RESOURCE_EXHAUSTED"
    http_status = 429
    reason = "LIMIT_EXCEEDED"
    title = "Limit of the key exceeded"

    def __init__(self, detail: str, retry_after: float) -> None:
        super().__init__(detail, retry_after=retry_after)


class UnknownModel(ServiceError):
    """Error of a call for a model that is not loaded."""

    code = "NOT_FOUND"
    http_status = 404
    reason = "UNKNOWN_MODEL"
    title = "Unknown model"


class UnknownTrack(ServiceError):
    """Error of a call for a scene or agent that the track memory does not know."""

    code = "NOT_FOUND"
    http_status = 404
    reason = "UNKNOWN_TRACK"
    title = "Not remembered"


class UnknownRaster(ServiceError):
    """Error of a call that names a raster by its digest alone, which the server does not have."""

    code = "FAILED_PRECONDITION"
    http_status = 412
    reason = "UNKNOWN_RASTER"
    title = "Unknown raster"

    def __init__(self, digest: bytes) -> None:
        super().__init__(f"no raster with the digest {digest.hex()} is kept; send it whole")


def check_id(field: str, value: str) -> None:
    """Refuse an id of a scene or agent that is missing or too long.

    Args:
        field: the path of the id in the request.
        value: the id.

    Raises:
        BadField: the id is empty, or longer than the contract allows.
    """
    if not value:
        raise BadField(field, "is required")
    if len(value) > MAX_ID_LENGTH:
        raise BadField(field, id_too_long(value))


class TooLarge(ServiceError):
    """Error of a request that exceeds a size limit; a retry would fail the same way."""

    code = "RESOURCE_EXHAUSTED"
    http_status = 413
    reason = "TOO_LARGE"
    title = "Request too large"


class Overloaded(ServiceError):
    """Error of a call that the server has no room for at the moment."""

    code = "RESOURCE_EXHAUSTED"
    http_status = 429
    reason = "OVERLOADED"
    title = "Overloaded"

    def __init__(self, detail: str, retry_after: float) -> None:
        super().__init__(detail, retry_after=retry_after)


class DeadlineExceeded(ServiceError):
    """Error of a call whose deadline passed before a forecast was made."""

    code = "DEADLINE_EXCEEDED"
    http_status = 504
    reason = "DEADLINE_EXCEEDED"
    title = "Deadline exceeded"

    def __init__(self, detail: str = "the deadline passed before a forecast was made") -> None:
        super().__init__(detail)


class RequestTimeout(ServiceError):
    """Error of a call whose request did not arrive in time."""

    code = "DEADLINE_EXCEEDED"
    http_status = 408
    reason = "REQUEST_TIMEOUT"
    title = "Request timeout"


class Unavailable(ServiceError):
    """Error of a call to a server that is not ready."""

    code = "UNAVAILABLE"
    http_status = 503
    reason = "UNAVAILABLE"
    title = "Not ready"

    def __init__(self, detail: str, retry_after: float = 1.0) -> None:
        super().__init__(detail, retry_after=retry_after)


class TrackingUnavailable(ServiceError):
    """Error of a consistency call while the track memory does not respond; forecasts go on without it."""

    code = "UNAVAILABLE"
    http_status = 503
    reason = "TRACKING_UNAVAILABLE"
    title = "Track memory not available"

    def __init__(self, detail: str, retry_after: float = 1.0) -> None:
        super().__init__(detail, retry_after=retry_after)


class Internal(ServiceError):
    """Error of the server itself; details are in its log only."""

    def __init__(self, detail: str = "the server failed to answer; its log says why") -> None:
        super().__init__(detail)


class NotFound(ServiceError):
    """Error of an unknown path (REST)."""

    code = "NOT_FOUND"
    http_status = 404
    reason = "NO_SUCH_ADDRESS"
    title = "No such address"


class MethodNotAllowed(ServiceError):
    """Error of a method that the path does not support (REST)."""

    code = "UNIMPLEMENTED"
    http_status = 405
    reason = "METHOD_NOT_ALLOWED"
    title = "Method not allowed"


class NotAcceptable(ServiceError):
    """Error of a request that accepts no media type of the response (REST)."""

    code = "INVALID_ARGUMENT"
    http_status = 406
    reason = "NOT_ACCEPTABLE"
    title = "Not acceptable"


class UnsupportedMediaType(ServiceError):
    """Error of a request body of an unsupported media type (REST)."""

    code = "INVALID_ARGUMENT"
    http_status = 415
    reason = "UNSUPPORTED_MEDIA_TYPE"
    title = "Unsupported media type"


TABLE: tuple[type[ServiceError], ...] = (
    BadFields,
    Unauthenticated,
    PermissionDenied,
    ReloadRefused,
    LimitExceeded,
    UnknownModel,
    UnknownTrack,
    UnknownRaster,
    TooLarge,
    Overloaded,
    DeadlineExceeded,
    RequestTimeout,
    Unavailable,
    TrackingUnavailable,
    Internal,
    NotFound,
    MethodNotAllowed,
    NotAcceptable,
    UnsupportedMediaType,
)
"""Rows of the table."""
