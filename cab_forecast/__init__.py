"""Public client of a cab-forecast server.

Names are imported on first use, so that a program that only calls ``predict`` loads protobuf and one
transport, but neither numpy nor Pillow.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cab_forecast.client import AsyncClient, Client
    from cab_forecast.demo import demo_request
    from cab_forecast.errors import (
        BadRequest,
        DeadlineExceeded,
        FieldViolation,
        ForecastError,
        InternalError,
        LimitExceeded,
        NotFound,
        Overloaded,
        PermissionDenied,
        TooLarge,
        TrackingUnavailable,
        Unauthenticated,
        Unavailable,
        UnknownRaster,
        UnknownTrack,
        Untrusted,
    )
    from cab_forecast.explanations import as_explain_request, explain_options, explain_request
    from cab_forecast.forecast import Forecast, InputWarning, Status, Tracking, forecasts, tracking
    from cab_forecast.rasters import raster_digest
    from cab_forecast.requests import agent, map_patch, predict_request, scene_raster
    from cab_forecast.streams import AsyncStream, Stream

__all__ = [
    "AsyncClient",
    "AsyncStream",
    "BadRequest",
    "Client",
    "DeadlineExceeded",
    "FieldViolation",
    "Forecast",
    "ForecastError",
    "InputWarning",
    "InternalError",
    "LimitExceeded",
    "NotFound",
    "Overloaded",
    "PermissionDenied",
    "Status",
    "Stream",
    "TooLarge",
    "Tracking",
    "TrackingUnavailable",
    "Unauthenticated",
    "Unavailable",
    "UnknownRaster",
    "UnknownTrack",
    "Untrusted",
    "agent",
    "as_explain_request",
    "demo_request",
    "explain_options",
    "explain_request",
    "forecasts",
    "map_patch",
    "predict_request",
    "raster_digest",
    "scene_raster",
    "tracking",
]

_MODULES = {
    "AsyncClient": "client",
    "AsyncStream": "streams",
    "Client": "client",
    "demo_request": "demo",
    "as_explain_request": "explanations",
    "explain_options": "explanations",
    "explain_request": "explanations",
    "Forecast": "forecast",
    "InputWarning": "forecast",
    "Status": "forecast",
    "Stream": "streams",
    "Tracking": "forecast",
    "forecasts": "forecast",
    "tracking": "forecast",
    "raster_digest": "rasters",
    "agent": "requests",
    "map_patch": "requests",
    "predict_request": "requests",
    "scene_raster": "requests",
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES.get(name, 'errors')}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
