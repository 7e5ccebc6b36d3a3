"""OpenAPI document: the contract as REST serves it."""

from collections.abc import Callable
from importlib import metadata
from typing import Any

from google.protobuf.message import Message

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as predict_pb
from cab.forecast.v1 import scene_service_pb2 as scenes_pb
from cab.forecast.v1.bounds import STEP_SECONDS
from cab.forecast.v1.routes import (
    EXPLAIN,
    GET_MODEL,
    PREDICT,
    RELOAD_MODELS,
    RESET_SCENE,
    ROUTES,
    WATCH_FORECASTS,
    WATCH_SCENE,
    Route,
)
from service.errors import ServiceError, Unavailable
from service.settings import Settings
from service.transports.method_errors import ACCESS, RETRYABLE, Errors, rest_errors
from service.transports.rest.codec import to_json
from service.transports.rest.negotiation import EVENT_STREAM, TIMEOUT_HEADER, Format
from service.transports.rest.problem import MEDIA_TYPE
from service.transports.rest.schemas import Schema, comments, message_schemas, query_parameters, reference

_DESCRIPTION = """Forecasts where road users will be in the next seconds, as Gaussian mixtures.

The messages are those of the gRPC contract (`cab.forecast.v1`) as JSON by protobuf's JSON mapping, or as
`application/x-protobuf`. Field names are read in snake_case and camelCase and written in snake_case.
Errors are `application/problem+json` (RFC 9457), with a machine-readable `reason`."""

_OPERATIONS = "Operations"
"""Tag of what is not of the contract."""
_BINARY = {"schema": {"type": "string", "format": "binary"}}

_NOW = 1_700_000_000.0
_MODEL = models_pb.ModelReference(name="kalman", version="1.0.0", protocol=models_pb.INPUT_PROTOCOL_CAUSAL)
_FRAMES = 9
EXAMPLE_IDS = {"scene_id": "street-1", "agent_id": "car-1"}
"""The scene that one of the examples names, and an agent of it."""


def openapi_document(settings: Settings, *, closed: bool = False) -> dict[str, Any]:
    """Return the document as a server with these settings serves it.

    Args:
        settings: the limits of requests.
        closed: True if callers need a key.
    """
    paths: dict[str, Schema] = {
        route.path: {route.verb.lower(): _operation(route, settings)} for route in ROUTES
    }
    paths |= {
        "/metrics": {"get": _probe("metrics", "Metrics in the Prometheus text format.", *ACCESS)},
    }
    if closed:
        for operations in paths.values():
            for operation in operations.values():
                operation["security"] = [{"bearer": []}]
    paths |= {
        "/livez": {"get": _probe("livez", "Liveness: whether the process responds.")},
        "/readyz": {"get": _probe("readyz", "Readiness: whether the server accepts calls.", Unavailable)},
    }
    document: dict[str, Any] = {
        "openapi": "3.1.0",
        "info": {
            "title": "cab-forecast",
            "version": metadata.version("cab-forecast"),
            "description": _DESCRIPTION,
            "license": {"name": "Apache-2.0", "identifier": "Apache-2.0"},
        },
        "tags": _tags(),
        "paths": paths,
        "components": {"schemas": message_schemas(settings) | {"Problem": _problem_schema()}},
    }
    if closed:
        document["components"]["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
    return document


def _tag(service: str) -> str:
    """Return the tag of a service's methods, e.g. "Prediction"."""
    return service.rpartition(".")[2].removesuffix("Service")


def _tags() -> list[Schema]:
    """Return the tags in the order of the route table, with the comments of the services."""
    services = dict.fromkeys(route.service for route in ROUTES)
    described = [
        {"name": _tag(service), "description": comments()[service.rpartition(".")[2]]} for service in services
    ]
    return [*described, {"name": _OPERATIONS, "description": "Probes and metrics, outside the contract."}]


def _operation(route: Route[Any, Any], settings: Settings) -> Schema:
    """Return the operation of a method; its description is the comment of the contract."""
    text = comments()[f"{route.service.rpartition('.')[2]}.{route.method}"]
    response = route.response.DESCRIPTOR.name
    content = (
        _event_content(route)
        if route.streaming
        else {Format.JSON.value: {"schema": reference(response)}, Format.PROTOBUF.value: _BINARY}
    )
    operation: Schema = {
        "operationId": route.method,
        "tags": [_tag(route.service)],
        "summary": text.split(". ")[0].rstrip("."),
        "description": text,
        "responses": {
            "200": {"description": "The response.", "content": content},
            **_problems(rest_errors(route)),
        },
    }
    parameters = _parameters(route, settings)
    if parameters:
        operation["parameters"] = parameters
    if route.verb == "POST":
        examples = _EXAMPLES[route]()
        json = {"schema": reference(route.request.DESCRIPTOR.name), "examples": examples}
        body = {Format.JSON.value: json, Format.PROTOBUF.value: _BINARY}
        operation["requestBody"] = {"required": True, "content": body}
    return operation


def _parameters(route: Route[Any, Any], settings: Settings) -> list[Schema]:
    """Return the parameters of a method in path, query and headers."""
    if route in (PREDICT, EXPLAIN):
        return [
            _timeout_parameter(
                "Seconds that the client waits for the response; work not begun by then is dropped."
            )
        ]
    if route is GET_MODEL:
        return [
            {
                "name": "name",
                "in": "path",
                "required": True,
                "description": '"name", for the newest version, or "name@version".',
                "schema": {"type": "string", "minLength": 1},
                "example": "kalman",
            }
        ]
    if route.verb == "POST":
        return []
    parameters = query_parameters(route.request.DESCRIPTOR, settings, EXAMPLE_IDS | {"window": 2.0})
    for parameter in parameters:
        if f"{{{parameter['name']}}}" in route.path:
            parameter["in"] = "path"
    if route.streaming:
        parameters.append(
            _timeout_parameter("Seconds after which the stream ends; without this header it goes on.")
        )
    return parameters


def _event_content(route: Route[Any, Any]) -> Schema:
    """Return the content of a method's response of Server-Sent Events."""
    message = route.response.DESCRIPTOR.name
    data = {
        "type": "string",
        "contentMediaType": Format.JSON.value,
        "contentSchema": {"oneOf": [reference(message), reference("Problem")]},
    }
    # OpenAPI 3.1 cannot describe streams; tools take the schema for that of each event.
    schema = {
        "type": "object",
        "description": f"One Server-Sent Event: a {message}, or, in a last event of type `error`, a Problem. "
        "While there are no events, comments are sent as heartbeats.",
        "properties": {"event": {"type": "string", "enum": ["message", "error"]}, "data": data},
        "required": ["data"],
    }
    example = {"event": "message", "data": to_json(_EVENT_EXAMPLES[route]()).decode()}
    return {EVENT_STREAM: {"schema": schema, "example": example}}


def _timeout_parameter(description: str) -> Schema:
    return {
        "name": TIMEOUT_HEADER,
        "in": "header",
        "required": False,
        "description": description,
        "schema": {"type": "number", "exclusiveMinimum": 0},
    }


def _probe(name: str, description: str, *errors: type[ServiceError]) -> Schema:
    """Return an operation outside the contract, with a response in plain text."""
    content = {"text/plain": {"schema": {"type": "string"}}}
    return {
        "operationId": name,
        "tags": [_OPERATIONS],
        "summary": description.rstrip("."),
        "responses": {"200": {"description": "Success.", "content": content}, **_problems(errors)},
    }


def _problem_schema() -> Schema:
    """Return the schema of a problem document."""
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
        "description": "An error (RFC 9457).",
        "properties": {
            "type": {"type": "string", "format": "uri"},
            "title": text,
            "status": {"type": "integer"},
            "detail": text,
            "code": {"type": "string", "description": "Name of the gRPC status code."},
            "reason": {
                "type": "string",
                "description": "Machine-readable cause; tells errors with the same code apart.",
            },
            "errors": {"type": "array", "items": fault, "description": "The fields that are wrong."},
            "request_id": {
                "type": "string",
                "description": "Id of the request, as in the header x-request-id.",
            },
        },
        "required": ["type", "title", "status", "detail", "code", "reason", "errors"],
    }


def _problems(errors: Errors) -> dict[str, Schema]:
    """Return responses by HTTP status; errors with the same status share one."""
    responses: dict[str, Schema] = {}
    for error in sorted(errors, key=lambda row: row.http_status):
        text = f"{error.title} (`{error.reason}`)."
        response = responses.setdefault(
            str(error.http_status),
            {"description": "", "content": {MEDIA_TYPE: {"schema": reference("Problem")}}},
        )
        response["description"] = f"{response['description']} {text}".strip()
        if error in RETRYABLE:
            response["headers"] = {
                "Retry-After": {
                    "description": "Seconds to wait before a retry.",
                    "schema": {"type": "integer"},
                }
            }
    return responses


def predict_examples() -> dict[str, dict[str, Any]]:
    """Return example requests of Predict by name; each works as it stands."""
    car = _agent(EXAMPLE_IDS["agent_id"], "AGENT_TYPE_VEHICLE", x=100.0, y=50.0, speed=8.0)
    walker = _agent("walker-1", "AGENT_TYPE_PEDESTRIAN", x=110.0, y=56.0, speed=1.4)
    parked = _agent("car-2", "AGENT_TYPE_VEHICLE", x=130.0, y=47.0, speed=0.0) | {"predict": False}
    return {
        "one_car": {
            "summary": "One car, with the server's default model",
            "value": {"time": _NOW, "agents": [car]},
        },
        "street": {
            "summary": "A car and a pedestrian beside a parked car; at most three merged modes, 3 s ahead",
            "value": {
                "scene_id": EXAMPLE_IDS["scene_id"],
                "time": _NOW,
                "agents": [car, walker, parked],
                "options": {"merge": True, "max_modes": 3, "horizon": 3.0},
            },
        },
        "samples": {
            "summary": "Ten sampled trajectories from a named model",
            "value": {
                "time": _NOW,
                "model": "kalman",
                "agents": [car],
                "options": {"max_modes": 1, "samples": 10, "seed": 7},
            },
        },
    }


def explain_examples() -> dict[str, dict[str, Any]]:
    """Return example requests of Explain by name; each works as it stands."""
    car = _agent(EXAMPLE_IDS["agent_id"], "AGENT_TYPE_VEHICLE", x=100.0, y=50.0, speed=8.0)
    ahead = _agent("car-2", "AGENT_TYPE_VEHICLE", x=120.0, y=50.0, speed=4.0) | {"predict": False}
    return {
        "following": {
            "summary": "A car behind a slower one: what the forecast owes to it",
            "value": {"time": _NOW, "agents": [car, ahead], "options": {"by_neighbor": True}},
        }
    }


def reset_examples() -> dict[str, dict[str, Any]]:
    """Return example requests of ResetScene by name."""
    return {"street": {"summary": "Forget a scene", "value": {"scene_id": EXAMPLE_IDS["scene_id"]}}}


def reload_examples() -> dict[str, dict[str, Any]]:
    """Return example requests of ReloadModels by name."""
    return {"reload": {"summary": "Read the folder of models again", "value": {}}}


_EXAMPLES: dict[Route[Any, Any], Callable[[], dict[str, dict[str, Any]]]] = {
    PREDICT: predict_examples,
    EXPLAIN: explain_examples,
    RESET_SCENE: reset_examples,
    RELOAD_MODELS: reload_examples,
}


def _scene_example() -> consistency_pb.WatchSceneResponse:
    """Return an example event of WatchScene."""
    instant = consistency_pb.InstantConsistency(
        agent_id=EXAMPLE_IDS["agent_id"],
        time=_NOW,
        model=_MODEL,
        errors=[
            consistency_pb.AgeError(age=0.5, displacement_error=0.12, most_likely_was_nearest=True),
            consistency_pb.AgeError(age=1.0, displacement_error=0.31, most_likely_was_nearest=True),
        ],
    )
    return consistency_pb.WatchSceneResponse(instants=[instant])


def _forecasts_example() -> scenes_pb.WatchForecastsResponse:
    """Return an example event of WatchForecasts: one car, two steps ahead."""
    frame = scenes_pb.ForecastFrame(
        scene_id=EXAMPLE_IDS["scene_id"],
        time=_NOW,
        model=_MODEL,
        inference_seconds=0.002,
        steps=2,
        step=STEP_SECONDS,
    )
    frame.agents.add(
        id=EXAMPLE_IDS["agent_id"],
        type=models_pb.AGENT_TYPE_VEHICLE,
        predicted=True,
        status=predict_pb.FORECAST_STATUS_OK,
        states=[predict_pb.AgentState(time=_NOW, x=100.0, y=50.0, velocity_x=8.0, velocity_y=0.0)],
        weights=[1.0],
        means=[104.0, 50.0, 108.0, 50.0],
        covariances=[0.04, 0.0, 0.02, 0.12, 0.0, 0.06],
    )
    return scenes_pb.WatchForecastsResponse(frame=frame)


_EVENT_EXAMPLES: dict[Route[Any, Any], Callable[[], Message]] = {
    WATCH_SCENE: _scene_example,
    WATCH_FORECASTS: _forecasts_example,
}


def _agent(agent_id: str, kind: str, x: float, y: float, speed: float) -> dict[str, Any]:
    """Return an agent that moves along x and is now at (x, y)."""
    states = []
    for age in range(_FRAMES - 1, -1, -1):
        seconds = age * STEP_SECONDS
        states.append({"time": _NOW - seconds, "x": round(x - speed * seconds, 3), "y": y, "heading": 0.0})
    return {"id": agent_id, "type": kind, "states": states}
