"""JSON schemas of the contract's messages, from their descriptors and the comments of the .proto files."""

import base64
import functools
import re
from collections.abc import Iterable
from importlib import resources
from typing import Any

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor

from cab.forecast.v1.bounds import (
    FIELD_BOUNDS,
    MAX_DRAWS,
    MAX_ID_LENGTH,
    MAX_PERMUTATIONS,
    STEP_SECONDS,
)
from cab.forecast.v1.digest import DIGEST_BYTES
from cab.forecast.v1.routes import ROUTES
from service.settings import Settings
from service.tracking.store.base import WINDOW

Schema = dict[str, Any]

_UINT32_MAX = 2**32 - 1
_DIGEST_LENGTH = len(base64.b64encode(bytes(DIGEST_BYTES)))
_SCALARS: dict[int, Schema] = {
    FieldDescriptor.TYPE_DOUBLE: {"type": "number", "format": "double"},
    FieldDescriptor.TYPE_BYTES: {"type": "string", "format": "byte"},
    FieldDescriptor.TYPE_STRING: {"type": "string"},
    FieldDescriptor.TYPE_BOOL: {"type": "boolean"},
    FieldDescriptor.TYPE_UINT32: {"type": "integer", "minimum": 0, "maximum": _UINT32_MAX},
    # A string, by protobuf's JSON mapping: many JSON parsers read numbers as doubles.
    FieldDescriptor.TYPE_UINT64: {"type": "string", "format": "uint64", "pattern": "^[0-9]+$"},
}
REQUIRED = {
    "PredictRequest": ["time"],
    "ExplainRequest": ["time"],
    "Agent": ["id", "type", "states"],
    "AgentState": ["time", "x", "y"],
    "MapPatch": ["image"],
    "GetAgentConsistencyRequest": ["scene_id", "agent_id"],
    "GetSceneConsistencyRequest": ["scene_id"],
    "ResetSceneRequest": ["scene_id"],
    "WatchSceneRequest": ["scene_id"],
    "WatchForecastsRequest": ["scene_id"],
}
"""Required fields by message. Descriptors cannot tell; the comments of the contract say it in words."""
ALTERNATIVES = {
    "SceneRaster": [["image", "origin_x", "origin_y", "pixels_per_meter"], ["digest"]],
}
"""Messages that require the fields of one of several lists."""

_BLOCK = re.compile(r"(message|enum|service|oneof)\s+(\w+)\s*\{(\s*\})?")
_RPC = re.compile(r"rpc\s+(\w+)\s*\(")
_FIELD = re.compile(r"(?:optional\s+|repeated\s+)?(?:map<[^>]*>|[\w.]+)\s+(\w+)\s*=\s*\d+")
_VALUE = re.compile(r"([A-Z][A-Z0-9_]*)\s*=\s*\d+\s*;")


@functools.cache
def comments(package: str = "cab.forecast.v1") -> dict[str, str]:
    """Return the comments of the .proto files, which generated code does not carry.

    Args:
        package: Python package that contains the .proto files.

    Returns:
        The comment above each message, field, enum, value and method, in one line, by name within the
        package, e.g. "PredictRequest.time" or "PredictionService.Predict". A field of a oneof counts as a
        field of the message.
    """
    found: dict[str, str] = {}
    for file in resources.files(package).iterdir():
        if file.name.endswith(".proto"):
            found |= parse_comments(file.read_text(encoding="utf-8"))
    return found


def parse_comments(source: str) -> dict[str, str]:
    """Parse the comments of one .proto file, in the format of `buf format`: one declaration per line.

    Returns:
        The comments by name, as ``comments``.
    """
    found: dict[str, str] = {}
    scope: list[str | None] = []  # None: the members belong to the enclosing block
    lines: list[str] = []
    for line in map(str.strip, source.splitlines()):
        if line.startswith("//"):
            lines.append(line.removeprefix("//").strip())
            continue
        text, lines = " ".join(lines), []
        block = _BLOCK.match(line)
        declared = _RPC.match(line) or (scope and (_VALUE.match(line) or _FIELD.match(line))) or None
        if block and block[1] != "oneof":
            name = block[2]
        elif declared:
            name = declared[1]
        else:
            name = ""
        if name and text:
            found[".".join([part for part in scope if part] + [name])] = text
        if block and not block[3]:
            scope.append(None if block[1] == "oneof" else block[2])
        elif line == "}" and scope:
            scope.pop()
    return found


def bounds(settings: Settings) -> dict[str, Schema]:
    """Return the limits of request fields, as JSON schema keywords, by "Message.field"."""
    an_id = {"minLength": 1, "maxLength": MAX_ID_LENGTH}
    numbers = {name: {"minimum": low, "maximum": high} for name, (low, high) in FIELD_BOUNDS.items()}
    return numbers | {
        "PredictRequest.scene_id": {"maxLength": MAX_ID_LENGTH},
        "PredictRequest.agents": {"maxItems": settings.max_agents},
        "ExplainRequest.agents": {"maxItems": settings.max_agents},
        "ExplainOptions.draws": {"maximum": MAX_DRAWS},
        "ExplainOptions.permutations": {"maximum": MAX_PERMUTATIONS, "multipleOf": 2},
        "ExplainOptions.horizon": {"minimum": STEP_SECONDS, "multipleOf": STEP_SECONDS},
        "Agent.id": an_id,
        "Agent.states": {"minItems": 1, "maxItems": settings.max_states},
        "SceneRaster.rows": {"maximum": settings.max_raster_pixels},
        "SceneRaster.columns": {"maximum": settings.max_raster_pixels},
        "SceneRaster.digest": {"minLength": _DIGEST_LENGTH, "maxLength": _DIGEST_LENGTH},
        "PredictOptions.samples": {"maximum": settings.max_samples},
        "PredictOptions.horizon": {"minimum": STEP_SECONDS, "multipleOf": STEP_SECONDS},
        "GetAgentConsistencyRequest.scene_id": an_id,
        "GetAgentConsistencyRequest.agent_id": an_id,
        "GetAgentConsistencyRequest.window": {"minimum": 0, "maximum": WINDOW},
        "GetSceneConsistencyRequest.scene_id": an_id,
        "ResetSceneRequest.scene_id": an_id,
        "WatchSceneRequest.scene_id": an_id,
        "WatchForecastsRequest.scene_id": an_id,
    }


def message_schemas(settings: Settings) -> dict[str, Schema]:
    """Return the schemas of all messages and enums that REST carries, by name."""
    limits = bounds(settings)
    schemas: dict[str, Schema] = {}
    requests = [route.request for route in ROUTES if route.verb == "POST"]  # GET has no body
    responses = [route.response for route in ROUTES]
    for roots, are_requests in ((requests, True), (responses, False)):
        for descriptor in _reachable(root.DESCRIPTOR for root in roots):
            if descriptor.name in schemas:  # what requests may hold is the stricter description
                continue
            schemas[descriptor.name] = _message(descriptor, are_requests, limits)
            for field in descriptor.fields:
                if field.enum_type is not None:
                    schemas[field.enum_type.name] = _enum(field.enum_type)
    return dict(sorted(schemas.items()))


def query_parameters(descriptor: Descriptor, settings: Settings, examples: Schema) -> list[Schema]:
    """Return the query parameters of a GET: the fields of its request, which are scalars.

    Args:
        descriptor: descriptor of the request.
        settings: the limits.
        examples: an example value for each field.
    """
    limits = bounds(settings)
    parameters = []
    for field in descriptor.fields:
        name = f"{descriptor.name}.{field.name}"
        parameter: Schema = {
            "name": field.name,
            "in": "query",
            "required": field.name in REQUIRED.get(descriptor.name, []),
            "schema": _single(field) | limits.get(name, {}),
            "example": examples[field.name],
        }
        _describe(parameter, name)
        parameters.append(parameter)
    return parameters


def reference(name: str) -> Schema:
    """Return a reference to a schema."""
    return {"$ref": f"#/components/schemas/{name}"}


def _reachable(descriptors: Iterable[Descriptor]) -> list[Descriptor]:
    """Return messages and all that their fields contain, except the entries of maps."""
    found: list[Descriptor] = []
    pending = list(descriptors)
    while pending:
        current = pending.pop()
        if current in found:
            continue
        found.append(current)
        inner = [field.message_type for field in current.fields if field.message_type is not None]
        pending.extend(kind for kind in inner if not kind.GetOptions().map_entry)
    return found


def _message(descriptor: Descriptor, is_request: bool, limits: dict[str, Schema]) -> Schema:
    properties = {
        field.name: _field(field, f"{descriptor.name}.{field.name}", limits) for field in descriptor.fields
    }
    schema: Schema = {"type": "object", "properties": properties}
    _describe(schema, descriptor.name)
    if is_request:
        required = REQUIRED.get(descriptor.name, [])
        schema["additionalProperties"] = False
        if descriptor.name in ALTERNATIVES:
            schema["anyOf"] = [{"required": fields} for fields in ALTERNATIVES[descriptor.name]]
    else:
        required = [field.name for field in descriptor.fields if not field.has_presence]
    if required:
        schema["required"] = required
    choices = [oneof for oneof in descriptor.oneofs if not oneof.name.startswith("_")]
    if choices:
        some = [{"required": [field.name]} for oneof in choices for field in oneof.fields]
        # The first message of a stream and its heartbeats hold nothing
        schema["oneOf"] = some if is_request else [*some, {"not": {"anyOf": some}}]
    return schema


def _field(field: FieldDescriptor, name: str, limits: dict[str, Schema]) -> Schema:
    kind = field.message_type
    schema: Schema
    if kind is not None and kind.GetOptions().map_entry:
        schema = {"type": "object", "additionalProperties": _single(kind.fields_by_name["value"])}
    elif field.is_repeated:
        schema = {"type": "array", "items": _single(field)}
    else:
        schema = _single(field)
    schema |= limits.get(name, {})
    _describe(schema, name)
    return schema


def _single(field: FieldDescriptor) -> Schema:
    if field.message_type is not None:
        return reference(field.message_type.name)
    if field.enum_type is not None:
        return reference(field.enum_type.name)
    return dict(_SCALARS[field.type])


def _enum(kind: EnumDescriptor) -> Schema:
    names = [value.name for value in kind.values]
    texts = comments()
    lines = [texts.get(kind.name, "")]
    lines += [
        f"- `{name}`: {texts[f'{kind.name}.{name}']}" for name in names if f"{kind.name}.{name}" in texts
    ]
    return {"type": "string", "enum": names, "description": "\n".join(line for line in lines if line)}


def _describe(schema: Schema, name: str) -> None:
    text = comments().get(name)
    if text:
        schema["description"] = text
