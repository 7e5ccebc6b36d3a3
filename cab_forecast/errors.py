"""Exceptions of calls: one tree, the same for gRPC and REST."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

TOO_LARGE = "TOO_LARGE"
"""Reason of a RESOURCE_EXHAUSTED that a retry cannot fix."""
UNREACHABLE = "UNREACHABLE"
"""Reason of an UNAVAILABLE that the client raises itself, without a connection to the server."""
UNTRUSTED = "UNTRUSTED"
"""Reason of an UNAVAILABLE that the client raises itself: it does not trust the server's certificate."""
_UNTRUSTED_TEXT = "CERTIFICATE_VERIFY_FAILED"
"""Part of OpenSSL's and BoringSSL's message about such a certificate."""


@dataclass(frozen=True)
class FieldViolation:
    """One field that the server refused."""

    field: str
    """Path in the request, e.g. ``agents[3].states[1].x``."""
    description: str
    """Reason of the refusal."""


class ForecastError(Exception):
    """A failed call.

    Attributes:
        code: canonical status code by name, e.g. ``INVALID_ARGUMENT``; the same on both transports.
        message: the server's message, or the client's if there was no response.
        reason: machine-readable cause from the server, e.g. ``BAD_FIELD``; may be empty.
        field_violations: the fields that were refused.
        retry_after: seconds to wait before a retry; None: the server did not say.
        request_id: id by which the server's log names the call; empty: the server did not say.
    """

    default_code: ClassVar[str] = "UNKNOWN"
    retryable: ClassVar[bool] = False
    """True if the same request may succeed shortly afterwards."""

    def __init__(
        self,
        message: str,
        *,
        code: str | None = None,
        reason: str = "",
        field_violations: Sequence[FieldViolation] = (),
        retry_after: float | None = None,
        request_id: str = "",
    ) -> None:
        super().__init__(message)
        self.message = message
        self.code = code or self.default_code
        self.reason = reason
        self.field_violations = tuple(field_violations)
        self.retry_after = retry_after
        self.request_id = request_id

    def __str__(self) -> str:
        """Return the message, then each refused field that it does not name."""
        unnamed = [
            f"{v.field}: {v.description}" for v in self.field_violations if v.field not in self.message
        ]
        return "; ".join([self.message, *unnamed])


class BadRequest(ForecastError):  # noqa: N818 - named like the status codes
    """Fields of the request are invalid; ``field_violations`` names them."""

    default_code = "INVALID_ARGUMENT"


class Unauthenticated(ForecastError):  # noqa: N818
    """The key is missing or not valid."""

    default_code = "UNAUTHENTICATED"


class PermissionDenied(ForecastError):  # noqa: N818
    """The key does not permit the call: it lacks the scope."""

    default_code = "PERMISSION_DENIED"


class NotFound(ForecastError):  # noqa: N818
    """No such model. For scenes and agents see ``UnknownTrack``."""

    default_code = "NOT_FOUND"


class UnknownTrack(NotFound):
    """The server has no track of that scene or agent."""


class UnknownRaster(ForecastError):  # noqa: N818
    """The server has no raster with the digest that the request names, without an image."""

    default_code = "FAILED_PRECONDITION"


class TooLarge(ForecastError):  # noqa: N818
    """The request exceeds a size limit of the server; a retry cannot succeed."""

    default_code = "RESOURCE_EXHAUSTED"


class Overloaded(ForecastError):  # noqa: N818
    """The server's queue is full."""

    default_code = "RESOURCE_EXHAUSTED"
    retryable = True


class LimitExceeded(Overloaded):
    """The key has reached its rate, or its number of agents in progress."""


class DeadlineExceeded(ForecastError):  # noqa: N818
    """The call's timeout passed before a response arrived."""

    default_code = "DEADLINE_EXCEEDED"


class Unavailable(ForecastError):  # noqa: N818
    """The server is starting, draining, or cannot be reached."""

    default_code = "UNAVAILABLE"
    retryable = True


class Untrusted(Unavailable):
    """The server's certificate is not trusted: it is expired, of another host or of an unknown authority."""

    retryable = False


class TrackingUnavailable(Unavailable):
    """The server's track memory does not respond; forecasts go on without it."""


class InternalError(ForecastError):
    """The server failed, or its response cannot be parsed."""

    default_code = "INTERNAL"


def connection_failed(url: str, cause: str, *, may_need_certificate: bool) -> Unavailable:
    """Return the exception for a call that got no connection.

    Args:
        url: URL of the endpoint.
        cause: message of the transport.
        may_need_certificate: True if the server may have missed a certificate of the client.
    """
    if _UNTRUSTED_TEXT in cause:
        return Untrusted(f"the certificate of {url} is not trusted: {cause}", reason=UNTRUSTED)
    hint = " (it may require a certificate of the client)" if may_need_certificate else ""
    return Unavailable(f"no connection to {url}: {cause}{hint}", reason=UNREACHABLE)


_BY_CODE: dict[str, type[ForecastError]] = {
    "INVALID_ARGUMENT": BadRequest,
    "UNAUTHENTICATED": Unauthenticated,
    "PERMISSION_DENIED": PermissionDenied,
    "NOT_FOUND": NotFound,
    "RESOURCE_EXHAUSTED": Overloaded,
    "DEADLINE_EXCEEDED": DeadlineExceeded,
    "UNAVAILABLE": Unavailable,
    # A gRPC server that stops cancels calls that it has not started. A client's own cancellation is no error.
    "CANCELLED": Unavailable,
    "INTERNAL": InternalError,
    "DATA_LOSS": InternalError,
}
_BY_REASON: dict[tuple[str, str], type[ForecastError]] = {
    ("RESOURCE_EXHAUSTED", TOO_LARGE): TooLarge,
    ("RESOURCE_EXHAUSTED", "LIMIT_EXCEEDED"): LimitExceeded,
    ("NOT_FOUND", "UNKNOWN_TRACK"): UnknownTrack,
    ("FAILED_PRECONDITION", "UNKNOWN_RASTER"): UnknownRaster,
    ("UNAVAILABLE", "TRACKING_UNAVAILABLE"): TrackingUnavailable,
}
"""Exceptions that differ from others with the same code by their reason."""


def error_for(
    code: str,
    message: str,
    *,
    reason: str = "",
    field_violations: Sequence[FieldViolation] = (),
    retry_after: float | None = None,
    request_id: str = "",
) -> ForecastError:
    """Return the exception for a status; codes outside the contract become a plain ``ForecastError``.

    Args:
        code: canonical status code by name.
        message: message for people.
        reason: reason from the server's ErrorInfo.
        field_violations: fields that the server refused.
        retry_after: seconds; None: the server did not say.
        request_id: id of the request; empty: the server did not say.
    """
    kind = _BY_REASON.get((code, reason)) or _BY_CODE.get(code, ForecastError)
    return kind(
        message,
        code=code,
        reason=reason,
        field_violations=field_violations,
        retry_after=retry_after,
        request_id=request_id,
    )
