# ruff: noqa: N818 - rows of a table of errors, named as the contract names them
"""Everything that can go wrong with a call: one table for both transports.

The classes are the table's rows. A transport turns a row into its own form: gRPC into a google.rpc
status with details, REST into problem+json (RFC 9457). Nothing here knows of either.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from cab.forecast.v1.bounds import MAX_ID_LENGTH

DOMAIN = "cab-forecast"
"""Domain of google.rpc.ErrorInfo, and the namespace of the problem types."""


@dataclass(frozen=True)
class Fault:
    """One field of a request that is wrong, and why."""

    field: str
    """Path in the request, e.g. "agents[3].states[1].x"."""
    detail: str


def id_too_long(an_id: str) -> str:
    """Return the detail of the fault of an id that is longer than the contract allows."""
    return f"has {len(an_id)} characters; at most {MAX_ID_LENGTH}"


class ServiceError(Exception):
    """A call that gets no answer; the text is for the caller to read."""

    code: ClassVar[str] = "INTERNAL"
    """Name of the gRPC status code."""
    http_status: ClassVar[int] = 500
    reason: ClassVar[str] = "INTERNAL"
    """Machine-readable, UPPER_SNAKE; tells rows of one code apart."""
    title: ClassVar[str] = "Internal error"

    def __init__(
        self, detail: str, *, faults: Sequence[Fault] = (), retry_after: float | None = None
    ) -> None:
        """
        Args:
            detail: what is wrong in this call.
            faults: the fields that are wrong.
            retry_after: s until another try makes sense; None: do not retry.
        """
        super().__init__(detail)
        self.detail = detail
        self.faults = tuple(faults)
        self.retry_after = retry_after

    @classmethod
    def type_uri(cls) -> str:
        """URI of the problem type."""
        return f"urn:{DOMAIN}:error:{cls.reason.lower().replace('_', '-')}"


class BadFields(ServiceError):
    """Fields of the request break the contract."""

    code = "INVALID_ARGUMENT"
    http_status = 422
    reason = "BAD_FIELD"
    title = "Bad field"

    def __init__(self, faults: Sequence[Fault]) -> None:
        first = faults[0]
        more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
        super().__init__(f"{first.field}: {first.detail}{more}", faults=faults)


class BadField(BadFields):
    """One field of the request breaks the contract."""

    def __init__(self, field: str, detail: str) -> None:
        super().__init__([Fault(field, detail)])


class Unauthenticated(ServiceError):
    """No credentials, or wrong ones."""

    code = "UNAUTHENTICATED"
    http_status = 401
    reason = "UNAUTHENTICATED"
    title = "Credentials missing or wrong"


class UnknownModel(ServiceError):
    """No loaded model has that name (and version)."""

    code = "NOT_FOUND"
    http_status = 404
    reason = "UNKNOWN_MODEL"
    title = "Unknown model"


class UnknownTrack(ServiceError):
    """Nothing is remembered of that scene or agent."""

    code = "NOT_FOUND"
    http_status = 404
    reason = "UNKNOWN_TRACK"
    title = "Not remembered"


class TooLarge(ServiceError):
    """The request exceeds a size limit; another try would fail the same way."""

    code = "RESOURCE_EXHAUSTED"
    http_status = 413
    reason = "TOO_LARGE"
    title = "Request too large"


class Overloaded(ServiceError):
    """The queue is full."""

    code = "RESOURCE_EXHAUSTED"
    http_status = 429
    reason = "OVERLOADED"
    title = "Overloaded"

    def __init__(self, detail: str, retry_after: float) -> None:
        super().__init__(detail, retry_after=retry_after)


class DeadlineExceeded(ServiceError):
    """The deadline passed before a forecast was made."""

    code = "DEADLINE_EXCEEDED"
    http_status = 504
    reason = "DEADLINE_EXCEEDED"
    title = "Deadline exceeded"


class Unavailable(ServiceError):
    """The server is starting or draining."""

    code = "UNAVAILABLE"
    http_status = 503
    reason = "UNAVAILABLE"
    title = "Not ready"

    def __init__(self, detail: str, retry_after: float = 1.0) -> None:
        super().__init__(detail, retry_after=retry_after)


class TrackingUnavailable(ServiceError):
    """The track memory does not answer. Forecasts go on without it; this is for calls that are about it."""

    code = "UNAVAILABLE"
    http_status = 503
    reason = "TRACKING_UNAVAILABLE"
    title = "Track memory not available"

    def __init__(self, detail: str, retry_after: float = 1.0) -> None:
        super().__init__(detail, retry_after=retry_after)


class Internal(ServiceError):
    """A fault of the server; what exactly is in its log, not in the answer."""

    def __init__(self, detail: str = "the server failed to answer; its log says why") -> None:
        super().__init__(detail)


class NotFound(ServiceError):
    """No such address (REST)."""

    code = "NOT_FOUND"
    http_status = 404
    reason = "NO_SUCH_ADDRESS"
    title = "No such address"


class MethodNotAllowed(ServiceError):
    """The address does not know that method (REST)."""

    code = "UNIMPLEMENTED"
    http_status = 405
    reason = "METHOD_NOT_ALLOWED"
    title = "Method not allowed"


class NotAcceptable(ServiceError):
    """The answer does not come in any type that the request accepts (REST)."""

    code = "INVALID_ARGUMENT"
    http_status = 406
    reason = "NOT_ACCEPTABLE"
    title = "Not acceptable"


class UnsupportedMediaType(ServiceError):
    """The request's body is of a type that is not understood (REST)."""

    code = "INVALID_ARGUMENT"
    http_status = 415
    reason = "UNSUPPORTED_MEDIA_TYPE"
    title = "Unsupported media type"


TABLE: tuple[type[ServiceError], ...] = (
    BadFields,
    Unauthenticated,
    UnknownModel,
    UnknownTrack,
    TooLarge,
    Overloaded,
    DeadlineExceeded,
    Unavailable,
    TrackingUnavailable,
    Internal,
    NotFound,
    MethodNotAllowed,
    NotAcceptable,
    UnsupportedMediaType,
)
"""All rows."""
