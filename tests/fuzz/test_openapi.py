"""Requests generated from the OpenAPI document, with responses checked against it."""

import math
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis.core.result import Ok
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from service.server import Server

pytestmark = [
    pytest.mark.fuzz,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # schemathesis's own
    pytest.mark.filterwarnings("ignore:Generating overly large repr"),
]


CASES = settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
"""Settings for each operation. Plain hypothesis replaces schemathesis's plugin, which pytest 9.2 breaks."""

STREAMS = ("GET /v1/consistency/events", "GET /v1/scenes/{scene_id}/forecasts/watch")
RELOAD = "POST /v1/admin/reload-models"


def test_every_operation(server: Server) -> None:
    document = schemathesis.openapi.from_url(f"http://{server.http_address}/openapi.json")
    operations = []
    for result in document.get_all_operations():
        assert isinstance(result, Ok), result
        operations.append(result.ok())
    assert {operation.label for operation in operations} >= {
        "POST /v1/predict",
        "GET /v1/models",
        "GET /v1/models/{name}",
        "GET /v1/consistency/agent",
        "GET /v1/consistency/scene",
        "GET /v1/consistency/models",
        "POST /v1/consistency/reset",
        *STREAMS,
        RELOAD,
    }
    for operation in operations:
        # A reload reads all models anew, whatever its message says
        cases = settings(CASES, max_examples=10) if operation.label == RELOAD else CASES

        @cases
        @given(case=operation.as_strategy())
        def generated(case: Any) -> None:
            check(case)

        generated()


def check(case: Any) -> None:
    """Send a case and check the response."""
    if case.operation.label in STREAMS:  # otherwise the stream would not end
        case.headers["Request-Timeout"] = "0.01"
    response = case.call()
    case.validate_response(
        response,
        checks=[status_code_conformance, content_type_conformance, response_schema_conformance],
    )
    late = response.status_code == httpx.codes.GATEWAY_TIMEOUT and "Request-Timeout" in case.headers
    assert response.status_code < httpx.codes.INTERNAL_SERVER_ERROR or late, response.text
    if response.headers.get("content-type", [""])[0] == "application/json":
        assert finite(response.json())


def finite(value: object) -> bool:
    """Return whether a document has no NaN or infinity, as a number or as protobuf's string.

    Ids are texts of the caller's choice, such as "NaN".
    """
    if isinstance(value, dict):
        return all(finite(part) for name, part in value.items() if not name.endswith("_id"))
    if isinstance(value, list):
        return all(map(finite, value))
    if isinstance(value, float):
        return math.isfinite(value)
    return value not in {"NaN", "Infinity", "-Infinity"}
