"""The OpenAPI document: the contract as REST speaks it."""

from importlib import metadata
from typing import Any

from service.api.rest import problem
from service.api.rest.comments import comments
from service.api.rest.examples import predict_examples
from service.api.rest.negotiation import TIMEOUT_HEADER, Format
from service.api.rest.schemas import Schema, message_schemas, reference
from service.errors import (
    BadFields,
    DeadlineExceeded,
    Internal,
    MethodNotAllowed,
    NotAcceptable,
    NotFound,
    Overloaded,
    ServiceError,
    TooLarge,
    Unauthenticated,
    Unavailable,
    UnknownModel,
    UnsupportedMediaType,
)
from service.settings import Settings

_EVERY_CALL = (Unauthenticated, NotAcceptable, Unavailable, Internal)
_PREDICT = (
    BadFields,
    UnknownModel,
    TooLarge,
    UnsupportedMediaType,
    Overloaded,
    DeadlineExceeded,
)
_DESCRIPTION = """Forecasts where road users will be in the next seconds, as Gaussian mixtures.

The messages are those of the gRPC contract (`cab.forecast.v1`) as JSON by protobuf's JSON mapping, or as
`application/x-protobuf`. Field names are read in snake_case and camelCase and written in snake_case.
Errors are `application/problem+json` (RFC 9457); `reason` tells them apart."""


def openapi_document(settings: Settings) -> dict[str, Any]:
    """The document as a server with these settings serves it."""
    secured = bool(settings.api_tokens)
    schemas = message_schemas(settings) | {"Problem": _problem_schema()}
    document: dict[str, Any] = {
        "openapi": "3.1.0",
        "info": {
            "title": "cab-forecast",
            "version": metadata.version("cab-forecast"),
            "description": _DESCRIPTION,
            "license": {"name": "Apache-2.0", "identifier": "Apache-2.0"},
        },
        "paths": {
            "/v1/predict": {"post": _predict_operation()},
            "/v1/models": {
                "get": _operation("ListModels", "ModelService.ListModels", "ListModelsResponse", _EVERY_CALL)
            },
            "/v1/models/{name}": {"get": _get_model_operation()},
            "/livez": {"get": _probe("livez", "Whether the process answers at all.")},
            "/readyz": {"get": _probe("readyz", "Whether calls are taken.", Unavailable)},
            "/metrics": {"get": _probe("metrics", "Metrics in the Prometheus text format.")},
        },
        "components": {"schemas": schemas},
    }
    if secured:
        document["components"]["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
        for path, operations in document["paths"].items():
            if path.startswith("/v1/"):
                for operation in operations.values():
                    operation["security"] = [{"bearer": []}]
    return document


def _predict_operation() -> Schema:
    operation = _operation(
        "Predict", "PredictionService.Predict", "PredictResponse", (*_EVERY_CALL, *_PREDICT)
    )
    operation["parameters"] = [
        {
            "name": TIMEOUT_HEADER,
            "in": "header",
            "required": False,
            "description": "s that the client waits for the answer; what has not begun by then never does.",
            "schema": {"type": "number", "exclusiveMinimum": 0},
        }
    ]
    operation["requestBody"] = {
        "required": True,
        "content": {
            Format.JSON.value: {"schema": reference("PredictRequest"), "examples": predict_examples()},
            Format.PROTOBUF.value: {"schema": {"type": "string", "format": "binary"}},
        },
    }
    return operation


def _get_model_operation() -> Schema:
    operation = _operation(
        "GetModel",
        "ModelService.GetModel",
        "GetModelResponse",
        (*_EVERY_CALL, UnknownModel, NotFound, MethodNotAllowed),
    )
    operation["parameters"] = [
        {
            "name": "name",
            "in": "path",
            "required": True,
            "description": '"name", which means its newest version, or "name@version".',
            "schema": {"type": "string", "minLength": 1},
            "example": "kalman",
        }
    ]
    return operation


def _operation(
    operation_id: str, comment: str, answer: str, errors: tuple[type[ServiceError], ...]
) -> Schema:
    text = comments()[comment]
    answers = {
        Format.JSON.value: {"schema": reference(answer)},
        Format.PROTOBUF.value: {"schema": {"type": "string", "format": "binary"}},
    }
    return {
        "operationId": operation_id,
        "summary": text.split(". ")[0].rstrip("."),
        "description": text,
        "responses": {"200": {"description": "The answer.", "content": answers}, **_problems(errors)},
    }


def _probe(name: str, description: str, *errors: type[ServiceError]) -> Schema:
    content = {"text/plain": {"schema": {"type": "string"}}}
    return {
        "operationId": name,
        "summary": description.rstrip("."),
        "responses": {"200": {"description": "Yes.", "content": content}, **_problems(errors)},
    }


def _problems(errors: tuple[type[ServiceError], ...]) -> dict[str, Schema]:
    """Responses by HTTP status; rows that share one are listed together."""
    responses: dict[str, Schema] = {}
    for error in sorted(errors, key=lambda row: row.http_status):
        text = f"{error.title} (`{error.reason}`)."
        response = responses.setdefault(
            str(error.http_status),
            {"description": "", "content": {problem.MEDIA_TYPE: {"schema": reference("Problem")}}},
        )
        response["description"] = f"{response['description']} {text}".strip()
        if error in (Overloaded, Unavailable):
            response["headers"] = {
                "Retry-After": {
                    "description": "s until another try makes sense.",
                    "schema": {"type": "integer"},
                }
            }
    return responses


def _problem_schema() -> Schema:
    text = {"type": "string"}
    fault = {
        "type": "object",
        "properties": {
            "field": {"type": "string", "description": 'Path in the request, e.g. "agents[3].states[1].x".'},
            "detail": text,
        },
        "required": ["field", "detail"],
    }
    return {
        "type": "object",
        "description": "An error, by RFC 9457.",
        "properties": {
            "type": {"type": "string", "format": "uri"},
            "title": text,
            "status": {"type": "integer"},
            "detail": text,
            "code": {"type": "string", "description": "Name of the gRPC status code."},
            "reason": {"type": "string", "description": "Tells errors of one code apart."},
            "errors": {"type": "array", "items": fault, "description": "The fields that are wrong."},
        },
        "required": ["type", "title", "status", "detail", "code", "reason", "errors"],
    }
