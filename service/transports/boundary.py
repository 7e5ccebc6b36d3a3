"""What no transport lets through: an exception that is not in the error table."""

import structlog

from service.errors import Internal, ServiceError

_log = structlog.get_logger(__name__)


def to_service_error(error: Exception, method: str) -> ServiceError:
    """The table's row for an exception; of an unexpected one the caller learns nothing but that it was.

    Args:
        error: what the call raised.
        method: of the service, for the log.
    """
    if isinstance(error, ServiceError):
        return error
    _log.error("unexpected error", method=method, exc_info=error)
    return Internal()
