"""The pieces of OpenAPI's operations."""

from collections.abc import Sequence
from typing import Any

from service.errors import (
    Internal,
    NotAcceptable,
    Overloaded,
    ServiceError,
    TrackingUnavailable,
    Unauthenticated,
    Unavailable,
)
from service.transports.rest import problem
from service.transports.rest.comments import comments
from service.transports.rest.negotiation import EVENTS, TIMEOUT_HEADER, Format
from service.transports.rest.schemas import Schema, reference

Errors = tuple[type[ServiceError], ...]

EVERY_CALL: Errors = (Unauthenticated, NotAcceptable, Unavailable, Internal)
"""What any call of the contract can end with."""
_RETRYABLE = (Overloaded, Unavailable, TrackingUnavailable)
_BINARY = {"schema": {"type": "string", "format": "binary"}}


def operation(
    comment: str, answer: str, errors: Errors = (), parameters: Sequence[Schema] = (), body: Any = None
) -> Schema:
    """An operation.

    Args:
        comment: name of the contract's method, "Service.Method"; its comment describes the operation.
        answer: name of the message that it answers with.
        errors: what it can end with, besides what any call can.
        parameters: of its address or headers.
        body: of its request.
    """
    content = {Format.JSON.value: {"schema": reference(answer)}, Format.PROTOBUF.value: _BINARY}
    return _operation(comment, content, errors, parameters, body)


def events_operation(
    comment: str, answer: str, errors: Errors, parameters: Sequence[Schema], example: Schema
) -> Schema:
    """An operation that answers with Server-Sent Events; as ``operation``.

    Args:
        comment: as there.
        answer: name of the message that is in each event.
        errors: as there.
        parameters: as there.
        example: an event, by the names of its fields.
    """
    data = {
        "type": "string",
        "contentMediaType": Format.JSON.value,
        "contentSchema": {"oneOf": [reference(answer), reference("Problem")]},
    }
    # OpenAPI 3.1 has no word for streams; those who read it take the schema for that of each event
    schema = {
        "type": "object",
        "description": f"One of the Server-Sent Events: a {answer}, or in an `error`, which is the last, a "
        "Problem. Comments tell, where there are none for a while, that they go on.",
        "properties": {"event": {"type": "string", "enum": ["message", "error"]}, "data": data},
        "required": ["data"],
    }
    return _operation(comment, {EVENTS: {"schema": schema, "example": example}}, errors, parameters, None)


def body_of(message: str, examples: Schema) -> Schema:
    """A request's body.

    Args:
        message: its name.
        examples: by name, as OpenAPI has them.
    """
    json = {"schema": reference(message), "examples": examples}
    return {"required": True, "content": {Format.JSON.value: json, Format.PROTOBUF.value: _BINARY}}


def timeout_parameter(description: str) -> Schema:
    """The header that says how long the client waits."""
    return {
        "name": TIMEOUT_HEADER,
        "in": "header",
        "required": False,
        "description": description,
        "schema": {"type": "number", "exclusiveMinimum": 0},
    }


def probe(name: str, description: str, *errors: type[ServiceError]) -> Schema:
    """An operation that is not of the contract and answers with text."""
    content = {"text/plain": {"schema": {"type": "string"}}}
    return {
        "operationId": name,
        "summary": description.rstrip("."),
        "responses": {"200": {"description": "Yes.", "content": content}, **_problems(errors)},
    }


def problem_schema() -> Schema:
    """The schema of an error."""
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


def _operation(
    comment: str, content: Schema, errors: Errors, parameters: Sequence[Schema], body: Any
) -> Schema:
    text = comments()[comment]
    made: Schema = {
        "operationId": comment.rpartition(".")[2],
        "summary": text.split(". ")[0].rstrip("."),
        "description": text,
        "responses": {
            "200": {"description": "The answer.", "content": content},
            **_problems((*EVERY_CALL, *errors)),
        },
    }
    if parameters:
        made["parameters"] = list(parameters)
    if body is not None:
        made["requestBody"] = body
    return made


def _problems(errors: Errors) -> dict[str, Schema]:
    """Responses by HTTP status; rows that share one are listed together."""
    responses: dict[str, Schema] = {}
    for error in sorted(errors, key=lambda row: row.http_status):
        text = f"{error.title} (`{error.reason}`)."
        response = responses.setdefault(
            str(error.http_status),
            {"description": "", "content": {problem.MEDIA_TYPE: {"schema": reference("Problem")}}},
        )
        response["description"] = f"{response['description']} {text}".strip()
        if error in _RETRYABLE:
            response["headers"] = {
                "Retry-After": {
                    "description": "s until another try makes sense.",
                    "schema": {"type": "integer"},
                }
            }
    return responses
