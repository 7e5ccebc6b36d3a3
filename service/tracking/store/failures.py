"""Why a call of the track memory failed, in a word for the counts and in a sentence for the caller."""

from enum import StrEnum

from redis import exceptions as redis_errors

from service.tracking.store.base import StoreError


class Reason(StrEnum):
    """A word; these and no others, as each makes a series of a metric."""

    TIMEOUT = "timeout"
    REFUSED = "refused"
    """There is no connection, or it was lost."""
    CIRCUIT_OPEN = "circuit_open"
    SATURATED = "saturated"
    OUT_OF_MEMORY = "out_of_memory"
    READONLY = "readonly"
    LOADING = "loading"
    DENIED = "denied"
    """Wrong password, or the user may not do this."""
    CLUSTER_DOWN = "cluster_down"
    STOPPING = "stopping"
    OTHER = "other"


_TEXTS = {
    Reason.TIMEOUT: "the track memory did not answer in time",
    Reason.REFUSED: "the track memory cannot be reached",
    Reason.CIRCUIT_OPEN: "the track memory failed several times and is left alone for a moment",
    Reason.SATURATED: "the track memory has too much to do",
    Reason.OUT_OF_MEMORY: "the track memory is full",
    Reason.READONLY: "the track memory cannot be written to",
    Reason.LOADING: "the track memory is starting",
    Reason.DENIED: "the track memory does not let the server in",
    Reason.CLUSTER_DOWN: "a part of the track memory is down",
    Reason.STOPPING: "the server is stopping",
    Reason.OTHER: "the track memory failed",
}

_KINDS: tuple[tuple[type[Exception], Reason], ...] = (
    (TimeoutError, Reason.TIMEOUT),
    (redis_errors.TimeoutError, Reason.TIMEOUT),
    (redis_errors.MaxConnectionsError, Reason.SATURATED),
    (redis_errors.BusyLoadingError, Reason.LOADING),
    (redis_errors.AuthenticationError, Reason.DENIED),
    (redis_errors.AuthorizationError, Reason.DENIED),
    (redis_errors.NoPermissionError, Reason.DENIED),
    (redis_errors.ConnectionError, Reason.REFUSED),
    (OSError, Reason.REFUSED),
    (redis_errors.OutOfMemoryError, Reason.OUT_OF_MEMORY),
    (redis_errors.ReadOnlyError, Reason.READONLY),
    (redis_errors.ClusterError, Reason.CLUSTER_DOWN),
    (redis_errors.RedisClusterException, Reason.CLUSTER_DOWN),
)
"""The first that fits; an error that is a kind of another one stands before it."""


def reason_of(error: BaseException) -> Reason:
    """Why a call failed, by the error that it ended with."""
    return next((reason for kind, reason in _KINDS if isinstance(error, kind)), Reason.OTHER)


def store_error(reason: Reason) -> StoreError:
    """What the caller is told; nothing of where Redis is."""
    return StoreError(_TEXTS[reason])
