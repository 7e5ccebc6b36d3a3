"""The OpenAPI document: the contract as REST speaks it."""

from importlib import metadata
from typing import Any

from google.protobuf.descriptor import Descriptor

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from service.errors import (
    BadFields,
    DeadlineExceeded,
    MethodNotAllowed,
    NotFound,
    Overloaded,
    TooLarge,
    TrackingUnavailable,
    Unavailable,
    UnknownModel,
    UnknownTrack,
    UnsupportedMediaType,
)
from service.settings import Settings
from service.transports.rest.examples import IDS, events_example, predict_examples, reset_examples
from service.transports.rest.operations import (
    body_of,
    events_operation,
    operation,
    probe,
    problem_schema,
    timeout_parameter,
)
from service.transports.rest.schemas import Schema, message_schemas, query_parameters

_DESCRIPTION = """Forecasts where road users will be in the next seconds, as Gaussian mixtures.

The messages are those of the gRPC contract (`cab.forecast.v1`) as JSON by protobuf's JSON mapping, or as
`application/x-protobuf`. Field names are read in snake_case and camelCase and written in snake_case.
Errors are `application/problem+json` (RFC 9457); `reason` tells them apart."""


def openapi_document(settings: Settings) -> dict[str, Any]:
    """The document as a server with these settings serves it."""
    secured = bool(settings.api_tokens)
    schemas = message_schemas(settings) | {"Problem": problem_schema()}
    document: dict[str, Any] = {
        "openapi": "3.1.0",
        "info": {
            "title": "cab-forecast",
            "version": metadata.version("cab-forecast"),
            "description": _DESCRIPTION,
            "license": {"name": "Apache-2.0", "identifier": "Apache-2.0"},
        },
        "paths": {
            "/v1/predict": {"post": _predict()},
            "/v1/models": {"get": operation("ModelService.ListModels", "ListModelsResponse")},
            "/v1/models/{name}": {"get": _get_model()},
            **_consistency(settings),
            "/livez": {"get": probe("livez", "Whether the process answers at all.")},
            "/readyz": {"get": probe("readyz", "Whether calls are taken.", Unavailable)},
            "/metrics": {"get": probe("metrics", "Metrics in the Prometheus text format.")},
        },
        "components": {"schemas": schemas},
    }
    if secured:
        document["components"]["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
        for path, operations in document["paths"].items():
            if path.startswith("/v1/"):
                for each in operations.values():
                    each["security"] = [{"bearer": []}]
    return document


def _predict() -> Schema:
    waits = "s that the client waits for the answer; what has not begun by then never does."
    return operation(
        "PredictionService.Predict",
        "PredictResponse",
        (BadFields, UnknownModel, TooLarge, UnsupportedMediaType, Overloaded, DeadlineExceeded),
        [timeout_parameter(waits)],
        body_of("PredictRequest", predict_examples()),
    )


def _get_model() -> Schema:
    name = {
        "name": "name",
        "in": "path",
        "required": True,
        "description": '"name", which means its newest version, or "name@version".',
        "schema": {"type": "string", "minLength": 1},
        "example": "kalman",
    }
    errors = (UnknownModel, NotFound, MethodNotAllowed)
    return operation("ModelService.GetModel", "GetModelResponse", errors, [name])


def _consistency(settings: Settings) -> dict[str, Schema]:
    def query(descriptor: Descriptor) -> list[Schema]:
        return query_parameters(descriptor, settings, IDS | {"window": 2.0})

    asked = (BadFields, UnknownTrack, TrackingUnavailable)
    agent = operation(
        "ConsistencyService.GetAgentConsistency",
        "GetAgentConsistencyResponse",
        asked,
        query(consistency_pb.GetAgentConsistencyRequest.DESCRIPTOR),
    )
    scene = operation(
        "ConsistencyService.GetSceneConsistency",
        "GetSceneConsistencyResponse",
        asked,
        query(consistency_pb.GetSceneConsistencyRequest.DESCRIPTOR),
    )
    models = operation(
        "ConsistencyService.ListModelConsistency", "ListModelConsistencyResponse", (BadFields,)
    )
    events = events_operation(
        "ConsistencyService.WatchScene",
        "WatchSceneResponse",
        (BadFields, TrackingUnavailable, Overloaded),
        [
            *query(consistency_pb.WatchSceneRequest.DESCRIPTOR),
            timeout_parameter("s after which the events end; without it they go on."),
        ],
        events_example(),
    )
    reset = operation(
        "ConsistencyService.ResetScene",
        "ResetSceneResponse",
        (BadFields, TooLarge, UnsupportedMediaType, TrackingUnavailable),
        body=body_of("ResetSceneRequest", reset_examples()),
    )
    return {
        "/v1/consistency/agent": {"get": agent},
        "/v1/consistency/scene": {"get": scene},
        "/v1/consistency/models": {"get": models},
        "/v1/consistency/events": {"get": events},
        "/v1/consistency/reset": {"post": reset},
    }
