"""The route table: consistency with the contract, and with the code that reads it."""

import pytest

from cab.forecast.v1 import admin_service_pb2 as admin_pb
from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import explanation_service_pb2 as explanation_pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1 import scene_service_pb2 as scenes_pb
from cab.forecast.v1.routes import (
    EXPLAIN,
    GET_AGENT_CONSISTENCY,
    GET_MODEL,
    LIST_MODEL_CONSISTENCY,
    PREDICT,
    ROUTES,
    SERVICES,
)
from service.server import Server
from service.settings import Settings
from service.transports.calls import UNARY_METHODS, CallRecords
from service.transports.rest.endpoints import Endpoints
from service.transports.rest.openapi import openapi_document
from tests.service.servers import settings

FILES = (
    pb.DESCRIPTOR,
    explanation_pb.DESCRIPTOR,
    models_pb.DESCRIPTOR,
    consistency_pb.DESCRIPTOR,
    scenes_pb.DESCRIPTOR,
    admin_pb.DESCRIPTOR,
)


def test_routes_are_the_contracts_methods() -> None:
    methods = {
        (service.full_name, method.name): method
        for file in FILES
        for service in file.services_by_name.values()
        for method in service.methods
    }
    assert {(route.service, route.method) for route in ROUTES} == set(methods)
    assert len(ROUTES) == len(methods)
    assert {service for service, _ in methods} == set(SERVICES)
    for route in ROUTES:
        method = methods[route.service, route.method]
        assert route.request.DESCRIPTOR is method.input_type
        assert route.response.DESCRIPTOR is method.output_type
        assert route.streaming is method.server_streaming
        assert route.rpc == f"/{method.containing_service.full_name}/{method.name}"


def test_routes_differ_in_their_addresses() -> None:
    assert len({(route.verb, route.path) for route in ROUTES}) == len(ROUTES)


async def test_server_and_document_have_the_routes() -> None:
    server = Server(settings())
    try:
        endpoints = Endpoints(
            server.dataplane,
            CallRecords("rest", server.metrics, server.settings),
            server.settings,
            server.intake,
            server.access.gate,
        ).by_route()
    finally:
        await server.stop(drain=False)
    assert set(endpoints) == set(ROUTES)
    paths = openapi_document(Settings())["paths"]
    documented = {(verb, path) for path, verbs in paths.items() for verb in verbs if path.startswith("/v1/")}
    assert documented == {(route.verb.lower(), route.path) for route in ROUTES}
    unary = {route for route in ROUTES if not route.streaming}
    assert set(UNARY_METHODS) == unary - {PREDICT, EXPLAIN}


@pytest.mark.parametrize(
    ("name", "target"),
    [
        ("cab", "/v1/models/cab"),
        ("cab@1.0.0", "/v1/models/cab@1.0.0"),
        ("a b/ä", "/v1/models/a%20b%2F%C3%A4"),
    ],
)
def test_targets_with_a_path_parameter(name: str, target: str) -> None:
    assert GET_MODEL.target(models_pb.GetModelRequest(name=name)) == target


def test_targets_with_a_query() -> None:
    request = consistency_pb.GetAgentConsistencyRequest(scene_id="a/b c", agent_id="ä&", window=1.5)
    target = "/v1/consistency/agent?scene_id=a%2Fb%20c&agent_id=%C3%A4%26&window=1.5"
    assert GET_AGENT_CONSISTENCY.target(request) == target
    nothing = consistency_pb.ListModelConsistencyRequest()
    assert LIST_MODEL_CONSISTENCY.target(nothing) == "/v1/consistency/models"
    assert PREDICT.target(pb.PredictRequest(time=1.0)) == "/v1/predict"
