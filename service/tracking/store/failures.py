"""Failure reasons of the track memory: a label for metrics and a sentence for the caller."""

from enum import StrEnum

from redis import exceptions as redis_errors

from service.tracking.store.base import StoreError

STORE_FAILURES: tuple[type[Exception], ...] = (
    redis_errors.RedisError,
    redis_errors.RedisClusterException,
    OSError,
)
"""Errors of Redis or of the connection to it, timeouts included. Any other exception is a bug."""


class FailureReason(StrEnum):
    """Reason of a failure. The set is closed, since each reason is a metric series."""

    TIMEOUT = "timeout"
    REFUSED = "refused"
    """There is no connection, or it was lost."""
    CIRCUIT_OPEN = "circuit_open"
    SATURATED = "saturated"
    OUT_OF_MEMORY = "out_of_memory"
    READONLY = "readonly"
    LOADING = "loading"
    DENIED = "denied"
    """The password is wrong, or the user lacks the permission."""
    CLUSTER_DOWN = "cluster_down"
    STOPPING = "stopping"
    OTHER = "other"


_TEXTS = {
    FailureReason.TIMEOUT: "the track memory did not answer in time",
    FailureReason.REFUSED: "the track memory cannot be reached",
    FailureReason.CIRCUIT_OPEN: "the track memory failed repeatedly and is not called for a moment",
    FailureReason.SATURATED: "the track memory is overloaded",
    FailureReason.OUT_OF_MEMORY: "the track memory is full",
    FailureReason.READONLY: "the track memory is read-only",
    FailureReason.LOADING: "the track memory is starting",
    FailureReason.DENIED: "the track memory denies access to the server",
    FailureReason.CLUSTER_DOWN: "a part of the track memory is down",
    FailureReason.STOPPING: "the server is stopping",
    FailureReason.OTHER: "the track memory failed",
}

_REASONS: tuple[tuple[type[Exception], FailureReason], ...] = (
    (TimeoutError, FailureReason.TIMEOUT),
    (redis_errors.TimeoutError, FailureReason.TIMEOUT),
    (redis_errors.MaxConnectionsError, FailureReason.SATURATED),
    (redis_errors.BusyLoadingError, FailureReason.LOADING),
    (redis_errors.AuthenticationError, FailureReason.DENIED),
    (redis_errors.AuthorizationError, FailureReason.DENIED),
    (redis_errors.NoPermissionError, FailureReason.DENIED),
    (redis_errors.ConnectionError, FailureReason.REFUSED),
    (OSError, FailureReason.REFUSED),
    (redis_errors.OutOfMemoryError, FailureReason.OUT_OF_MEMORY),
    (redis_errors.ReadOnlyError, FailureReason.READONLY),
    (redis_errors.ClusterError, FailureReason.CLUSTER_DOWN),
    (redis_errors.RedisClusterException, FailureReason.CLUSTER_DOWN),
)
"""The first match counts; subclasses stand before their base classes."""


def reason_of(error: BaseException) -> FailureReason:
    """Return the reason of a failure from the exception."""
    return next((reason for kind, reason in _REASONS if isinstance(error, kind)), FailureReason.OTHER)


def store_error(reason: FailureReason) -> StoreError:
    """Return the error for the caller; it does not reveal the address of Redis."""
    return StoreError(_TEXTS[reason])
