"""Scopes of keys, and the scope that each method of the contract needs."""

from collections.abc import Mapping
from enum import StrEnum
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


class Scope(StrEnum):
    """Rights of a key."""

    PREDICT = "predict"
    """Forecasts and explanations."""
    READ = "read"
    """Consistency of agents, scenes and models; live scenes and their forecasts."""
    RESET = "reset"
    """Deletion of scenes from the track memory."""
    METRICS = "metrics"
    """Prometheus metrics."""
    ADMIN = "admin"
    """Changes of the running server."""


_SCOPES: Mapping[Route[Any, Any], Scope | None] = {
    PREDICT: Scope.PREDICT,
    EXPLAIN: Scope.PREDICT,
    LIST_MODELS: None,
    GET_MODEL: None,
    GET_VERSION: None,
    GET_AGENT_CONSISTENCY: Scope.READ,
    GET_SCENE_CONSISTENCY: Scope.READ,
    LIST_MODEL_CONSISTENCY: Scope.READ,
    WATCH_SCENE: Scope.READ,
    LIST_SCENES: Scope.READ,
    WATCH_FORECASTS: Scope.READ,
    RESET_SCENE: Scope.RESET,
    RELOAD_MODELS: Scope.ADMIN,
}


def scope_of(route: Route[Any, Any]) -> Scope | None:
    """Return the scope that a method needs; None: any key will do. Methods not listed above need admin."""
    return _SCOPES.get(route, Scope.ADMIN)
