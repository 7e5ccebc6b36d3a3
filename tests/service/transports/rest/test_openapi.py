"""The OpenAPI document: consistency with the contract, and working examples."""

from typing import Any

import httpx
import pytest
from google.protobuf import json_format

from cab.forecast.v1 import admin_service_pb2 as admin_pb
from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import explanation_service_pb2 as explanation_pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1 import scene_service_pb2 as scenes_pb
from service.settings import Settings
from service.tracking.store.base import WINDOW
from service.transports.rest.codec import to_dict
from service.transports.rest.openapi import EXAMPLE_IDS, openapi_document, predict_examples, reset_examples
from service.transports.rest.schemas import ALTERNATIVES, REQUIRED, bounds, comments, parse_comments
from tests.service.fakes import FakeForecaster
from tests.service.servers import running

FILES = (
    pb.DESCRIPTOR,
    explanation_pb.DESCRIPTOR,
    models_pb.DESCRIPTOR,
    consistency_pb.DESCRIPTOR,
    scenes_pb.DESCRIPTOR,
    admin_pb.DESCRIPTOR,
)
DOCUMENT = openapi_document(Settings())
SCHEMAS: dict[str, Any] = DOCUMENT["components"]["schemas"]


def test_every_message_field_and_value_has_its_comment_or_a_neighbor_has() -> None:
    texts = comments()
    for file in FILES:
        for name, service in file.services_by_name.items():
            assert name in texts
            assert all(f"{name}.{method.name}" in texts for method in service.methods)
    assert texts["PredictRequest.time"].startswith("The present: forecasts start here.")
    assert texts["LayerImage.png"].startswith("An 8-bit RGB image")
    assert texts["ForecastStatus.FORECAST_STATUS_SHORT_HISTORY"].startswith("A forecast from fewer")
    assert texts["Model.benchmark"].startswith("Benchmark figures")
    known = {m for file in FILES for m in file.message_types_by_name}
    known |= {e for file in FILES for e in file.enum_types_by_name}
    known |= {s for file in FILES for s in file.services_by_name}
    recorded = {"RecordedCall", "RecordedMap", "RecalledHistory"}  # files, not calls
    assert {name.partition(".")[0] for name in texts} <= known | recorded


def test_comments_of_nested_blocks() -> None:
    source = """
    // Lost: a blank line follows.

    // Outer.
    message Outer {
      oneof choice {
        // One.
        string one = 1;
      }
      // Empty.
      message Empty {}
      // Two,
      // in two lines.
      repeated a.b.C two = 2;
      int32 three = 3;
    }
    """
    assert parse_comments(source) == {
        "Outer": "Outer.",
        "Outer.one": "One.",
        "Outer.Empty": "Empty.",
        "Outer.two": "Two, in two lines.",
    }


def test_schemas_have_the_messages_fields() -> None:
    for name, descriptor in pb.DESCRIPTOR.message_types_by_name.items():
        assert list(SCHEMAS[name]["properties"]) == [field.name for field in descriptor.fields]
    assert SCHEMAS["Agent"]["additionalProperties"] is False
    assert SCHEMAS["Agent"]["properties"]["type"]["$ref"] == "#/components/schemas/AgentType"
    assert SCHEMAS["AgentType"]["enum"][1] == "AGENT_TYPE_VEHICLE"
    assert SCHEMAS["Model"]["properties"]["benchmark"]["additionalProperties"]["type"] == "number"
    assert SCHEMAS["LayerImage"]["oneOf"] == [{"required": ["packed_bits"]}, {"required": ["png"]}]
    assert {"not": {"anyOf": SCHEMAS["WatchForecastsResponse"]["oneOf"][:-1]}} in (
        SCHEMAS["WatchForecastsResponse"]["oneOf"]
    )
    whole, named = SCHEMAS["SceneRaster"]["anyOf"]
    assert named == {"required": ["digest"]}
    assert "image" in whole["required"]
    assert "weights" in SCHEMAS["AgentForecast"]["required"]
    assert "model" not in SCHEMAS["AgentForecast"]["required"]


def test_hand_written_parts_name_real_fields() -> None:
    messages = {name: kind for file in FILES for name, kind in file.message_types_by_name.items()}
    for name, fields in REQUIRED.items():
        assert set(fields) <= {field.name for field in messages[name].fields}
    for name, alternatives in ALTERNATIVES.items():
        for fields in alternatives:
            assert set(fields) <= {field.name for field in messages[name].fields}
    for path in bounds(Settings()):
        name, _, field = path.partition(".")
        assert field in messages[name].fields_by_name


def test_every_method_of_the_contract_has_an_operation() -> None:
    operations = {each["operationId"] for path in DOCUMENT["paths"].values() for each in path.values()}
    methods = {m.name for file in FILES for s in file.services_by_name.values() for m in s.methods}
    assert methods <= operations


def test_parameters_are_the_requests_fields() -> None:
    scene, agent, window = DOCUMENT["paths"]["/v1/consistency/agent"]["get"]["parameters"]
    assert (scene["name"], scene["required"], scene["schema"]["maxLength"]) == ("scene_id", True, 128)
    assert agent["example"] == "car-1"
    assert (window["required"], window["schema"]["maximum"]) == (False, WINDOW)
    assert window["description"].startswith("s back from the agent's newest observation")
    assert "parameters" not in DOCUMENT["paths"]["/v1/consistency/models"]["get"]


def test_counts_are_strings_as_protobuf_writes_them() -> None:
    assert SCHEMAS["Summary"]["properties"]["count"]["type"] == "string"
    assert to_dict(consistency_pb.Summary(count=7))["count"] == "7"


def test_events_are_documented() -> None:
    watch = DOCUMENT["paths"]["/v1/consistency/events"]["get"]
    assert sorted(watch["responses"]) == ["200", "401", "403", "406", "422", "429", "500", "503"]
    (content,) = watch["responses"]["200"]["content"].items()
    assert content[0] == "text/event-stream"
    event = content[1]["example"]
    assert json_format.Parse(event["data"], consistency_pb.WatchSceneResponse()).instants
    assert "WatchSceneResponse" in SCHEMAS


def test_references_lead_somewhere() -> None:
    def walk(node: Any) -> None:
        if isinstance(node, dict):
            if "$ref" in node:
                assert node["$ref"].removeprefix("#/components/schemas/") in SCHEMAS
            for value in node.values():
                walk(value)
        elif isinstance(node, list):
            for value in node:
                walk(value)

    walk(DOCUMENT)


def test_errors_are_documented() -> None:
    responses = DOCUMENT["paths"]["/v1/predict"]["post"]["responses"]
    assert sorted(responses) == [
        "200",
        "401",
        "403",
        "404",
        "406",
        "408",
        "412",
        "413",
        "415",
        "422",
        "429",
        "500",
        "503",
        "504",
    ]
    assert "Retry-After" in responses["429"]["headers"]
    assert "application/problem+json" in responses["422"]["content"]


def test_security_is_documented_when_there_is_some() -> None:
    assert "securitySchemes" not in DOCUMENT["components"]
    secured = openapi_document(Settings(), closed=True)
    assert secured["paths"]["/v1/predict"]["post"]["security"] == [{"bearer": []}]
    assert "security" not in secured["paths"]["/livez"]["get"]


@pytest.mark.parametrize("default", ["baselines", "fake"])
async def test_examples_work(default: str) -> None:
    fakes = [FakeForecaster(history_frames=9)] if default == "fake" else []
    async with running(*fakes) as server, httpx.AsyncClient() as client:
        base = f"http://{server.http_address}"
        document = (await client.get(f"{base}/openapi.json")).json()
        content = document["paths"]["/v1/predict"]["post"]["requestBody"]["content"]
        examples = content["application/json"]["examples"]
        assert examples == predict_examples()
        for example in examples.values():
            response = await client.post(f"{base}/v1/predict", json=example["value"])
            assert response.status_code == 200, response.text
            forecasts = response.json()["forecasts"]
            assert forecasts
            assert all(forecast["status"] == "FORECAST_STATUS_OK" for forecast in forecasts)
        found = await client.get(
            f"{base}/v1/consistency/agent", params=EXAMPLE_IDS
        )  # one of them names a scene
        assert found.status_code == 200, found.text
        for example in reset_examples().values():
            response = await client.post(f"{base}/v1/consistency/reset", json=example["value"])
            assert response.json()["agents"] > 0


def test_every_operation_has_a_tag_that_is_described() -> None:
    document = openapi_document(Settings())
    described = {tag["name"]: tag["description"] for tag in document["tags"]}
    assert all(described.values())
    used = {
        name: operation["tags"]
        for operations in document["paths"].values()
        for operation in operations.values()
        for name in [operation["operationId"]]
    }
    assert {tag for tags in used.values() for tag in tags} == described.keys()
    assert used["Predict"] == ["Prediction"]
    assert used["livez"] == ["Operations"]
