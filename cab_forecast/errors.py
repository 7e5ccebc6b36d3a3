"""What can go wrong with a call: one exception tree, the same for gRPC and REST."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

TOO_LARGE = "TOO_LARGE"
"""Reason of a RESOURCE_EXHAUSTED that no retry can mend."""
UNREACHABLE = "UNREACHABLE"
"""Reason of an UNAVAILABLE that the client itself found: there is no connection to the server."""


@dataclass(frozen=True)
class FieldViolation:
    """One field that the server refused."""

    field: str
    """Where it is in the request, e.g. ``agents[3].states[1].x``."""
    description: str
    """What is wrong with it."""


class ForecastError(Exception):
    """A call that brought no answer.

    Attributes:
        code: canonical status code by name, e.g. ``INVALID_ARGUMENT``; the same on both transports.
        message: the server's sentence, or the client's when there was no server.
        reason: machine-readable cause in the server's own words, e.g. ``BAD_FIELD``; may be empty.
        field_violations: the fields that were refused.
        retry_after: s to wait before trying again, if the server said so.
    """

    default_code: ClassVar[str] = "UNKNOWN"
    retryable: ClassVar[bool] = False
    """Whether the same request may succeed in a moment."""

    def __init__(
        self,
        message: str,
        *,
        code: str | None = None,
        reason: str = "",
        field_violations: Sequence[FieldViolation] = (),
        retry_after: float | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.code = code or self.default_code
        self.reason = reason
        self.field_violations = tuple(field_violations)
        self.retry_after = retry_after

    def __str__(self) -> str:
        """The message, then each refused field that it does not name itself."""
        untold = [f"{v.field}: {v.description}" for v in self.field_violations if v.field not in self.message]
        return "; ".join([self.message, *untold])


class BadRequest(ForecastError):  # noqa: N818 - named by what happened, as the status codes are
    """A field of the request is wrong; ``field_violations`` names it."""

    default_code = "INVALID_ARGUMENT"


class Unauthenticated(ForecastError):  # noqa: N818
    """The token is missing or wrong."""

    default_code = "UNAUTHENTICATED"


class NotFound(ForecastError):  # noqa: N818
    """No such model; ``UnknownTrack`` for scenes and agents."""

    default_code = "NOT_FOUND"


class UnknownTrack(NotFound):
    """The server remembers nothing of that scene or agent."""


class TooLarge(ForecastError):  # noqa: N818
    """The request exceeds a size limit of the server; sending it again is of no use."""

    default_code = "RESOURCE_EXHAUSTED"


class Overloaded(ForecastError):  # noqa: N818
    """The server's queue is full."""

    default_code = "RESOURCE_EXHAUSTED"
    retryable = True


class DeadlineExceeded(ForecastError):  # noqa: N818
    """The call's timeout passed before an answer came."""

    default_code = "DEADLINE_EXCEEDED"


class Unavailable(ForecastError):  # noqa: N818
    """The server is starting, draining, or cannot be reached."""

    default_code = "UNAVAILABLE"
    retryable = True


class TrackingUnavailable(Unavailable):
    """The server's track memory does not answer; forecasts go on without it."""


class InternalError(ForecastError):
    """The server failed, or its answer cannot be read."""

    default_code = "INTERNAL"


_BY_CODE: dict[str, type[ForecastError]] = {
    "INVALID_ARGUMENT": BadRequest,
    "UNAUTHENTICATED": Unauthenticated,
    "PERMISSION_DENIED": Unauthenticated,
    "NOT_FOUND": NotFound,
    "RESOURCE_EXHAUSTED": Overloaded,
    "DEADLINE_EXCEEDED": DeadlineExceeded,
    "UNAVAILABLE": Unavailable,
    # So a gRPC server that stops ends calls that it has not begun; a client's own cancelling is no error
    "CANCELLED": Unavailable,
    "INTERNAL": InternalError,
    "DATA_LOSS": InternalError,
}
_BY_REASON: dict[tuple[str, str], type[ForecastError]] = {
    ("RESOURCE_EXHAUSTED", TOO_LARGE): TooLarge,
    ("NOT_FOUND", "UNKNOWN_TRACK"): UnknownTrack,
    ("UNAVAILABLE", "TRACKING_UNAVAILABLE"): TrackingUnavailable,
}
"""What is told apart from others of its code by its reason."""


def error_for(
    code: str,
    message: str,
    *,
    reason: str = "",
    field_violations: Sequence[FieldViolation] = (),
    retry_after: float | None = None,
) -> ForecastError:
    """The exception for a status; codes outside the contract become a plain ``ForecastError``.

    Args:
        code: canonical status code by name.
        message: what happened, for people.
        reason: the server's ErrorInfo reason.
        field_violations: fields that were refused.
        retry_after: s.
    """
    kind = _BY_REASON.get((code, reason)) or _BY_CODE.get(code, ForecastError)
    return kind(message, code=code, reason=reason, field_violations=field_violations, retry_after=retry_after)
