"""Errors that each method of the contract can return, on which transport."""

from collections.abc import Mapping
from typing import Any

from cab.forecast.v1.routes import (
    EXPLAIN,
    GET_AGENT_CONSISTENCY,
    GET_MODEL,
    GET_SCENE_CONSISTENCY,
    GET_VERSION,
    LIST_MODEL_CONSISTENCY,
    LIST_MODELS,
    LIST_SCENES,
    PREDICT,
    RELOAD_MODELS,
    RESET_SCENE,
    WATCH_FORECASTS,
    WATCH_SCENE,
    Route,
)
from service.errors import (
    BadFields,
    DeadlineExceeded,
    Internal,
    LimitExceeded,
    MethodNotAllowed,
    NotAcceptable,
    NotFound,
    Overloaded,
    PermissionDenied,
    ReloadRefused,
    RequestTimeout,
    ServiceError,
    TooLarge,
    TrackingUnavailable,
    Unauthenticated,
    Unavailable,
    UnknownModel,
    UnknownRaster,
    UnknownTrack,
    UnsupportedMediaType,
)

Errors = tuple[type[ServiceError], ...]

ACCESS: Errors = (Unauthenticated, PermissionDenied, LimitExceeded)
"""Errors of callers without a key, without the scope, and beyond the limits of their key."""
RETRYABLE: Errors = (LimitExceeded, Overloaded, Unavailable, TrackingUnavailable)
"""Errors that tell when to try again."""
_ALL_METHODS: Errors = (*ACCESS, NotAcceptable, Overloaded, Unavailable, Internal)
_OF_A_SCENE: Errors = (
    BadFields,
    UnknownModel,
    UnknownRaster,
    TooLarge,
    UnsupportedMediaType,
    RequestTimeout,
    DeadlineExceeded,
)
_ERRORS: Mapping[Route[Any, Any], Errors] = {
    PREDICT: _OF_A_SCENE,
    EXPLAIN: _OF_A_SCENE,
    LIST_MODELS: (),
    GET_MODEL: (UnknownModel, NotFound, MethodNotAllowed),
    GET_VERSION: (),
    GET_AGENT_CONSISTENCY: (BadFields, UnknownTrack, TrackingUnavailable),
    GET_SCENE_CONSISTENCY: (BadFields, UnknownTrack, TrackingUnavailable),
    LIST_MODEL_CONSISTENCY: (BadFields,),
    WATCH_SCENE: (BadFields, TrackingUnavailable),
    LIST_SCENES: (BadFields,),
    WATCH_FORECASTS: (BadFields,),
    RESET_SCENE: (BadFields, TooLarge, UnsupportedMediaType, RequestTimeout, TrackingUnavailable),
    RELOAD_MODELS: (BadFields, TooLarge, UnsupportedMediaType, RequestTimeout, ReloadRefused),
}
_OF_THE_FRAMEWORK: Errors = (NotFound, MethodNotAllowed)
"""Errors of addresses that are no method's: such requests are not counted as its calls."""
_OF_A_BODY: Errors = (BadFields, TooLarge, RequestTimeout)
"""Errors of any request that gRPC brings, since all have a body there."""


def rest_errors(route: Route[Any, Any]) -> Errors:
    """Return the errors that REST can respond with at the address of a method."""
    return (*_ALL_METHODS, *_ERRORS[route])


def codes(transport: str, route: Route[Any, Any]) -> list[str]:
    """Return the canonical status codes that a call of a method can be counted with.

    Args:
        transport: "grpc" or "rest".
        route: the method.
    """
    errors = {*rest_errors(route), *(_OF_A_BODY if transport == "grpc" else ())}
    counted = {error.code for error in errors if error not in _OF_THE_FRAMEWORK}
    return sorted(counted | {"OK", "CANCELLED"})
