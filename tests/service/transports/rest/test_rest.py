"""HTTP side of REST: paths, media types, headers, limits."""

import re
from collections.abc import AsyncIterator

import httpx
import pytest
from google.protobuf import json_format

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from service.server import Server
from tests.service.fakes import FakeForecaster
from tests.service.requests import make_request
from tests.service.servers import call_grpc, from_problem, running

PROTOBUF = "application/x-protobuf"


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    async with running(FakeForecaster(), max_request_bytes=20_000) as made:
        yield made


@pytest.fixture
async def client(server: Server) -> AsyncIterator[httpx.AsyncClient]:
    async with httpx.AsyncClient(base_url=f"http://{server.http_address}", timeout=20) as made:
        yield made


def as_json(request: pb.PredictRequest) -> bytes:
    return json_format.MessageToJson(request).encode()


async def test_numbers_are_the_same_however_they_travel(server: Server, client: httpx.AsyncClient) -> None:
    request = make_request(3, samples=4, seed=1, max_modes=2)
    request.agents[1].states[0].x = float("nan")
    body = as_json(request)
    answers = [await call_grpc(server, request)]
    for content, content_type in ((body, "application/json"), (request.SerializeToString(), PROTOBUF)):
        for accept in ("application/json", PROTOBUF):
            response = await client.post(
                "/v1/predict", content=content, headers={"content-type": content_type, "accept": accept}
            )
            assert response.headers["content-type"] == accept
            answers.append(
                pb.PredictResponse.FromString(response.content)
                if accept == PROTOBUF
                else json_format.Parse(response.content, pb.PredictResponse())
            )
    for answer in answers:
        answer.ClearField("timing")
        assert answer == answers[0]


async def test_models(client: httpx.AsyncClient) -> None:
    listed = (await client.get("/v1/models")).json()["models"]
    assert [model["name"] for model in listed if model["is_default"]] == ["fake"]
    assert listed == sorted(listed, key=lambda model: model["name"])
    for name in ("fake", "fake@1.0.0"):
        assert (await client.get(f"/v1/models/{name}")).json()["model"]["name"] == "fake"
    response = await client.get("/v1/models/fake", headers={"accept": PROTOBUF})
    assert models_pb.GetModelResponse.FromString(response.content).model.modes == 4
    missing = from_problem(await client.get("/v1/models/nobody"))
    assert (missing.http_status, missing.reason) == (404, "UNKNOWN_MODEL")


async def test_probes(server: Server, client: httpx.AsyncClient) -> None:
    assert (await client.get("/livez")).status_code == 200
    assert (await client.get("/readyz")).status_code == 200
    server.dataplane.refuse()
    assert (await client.get("/livez")).status_code == 200
    refused = from_problem(await client.get("/readyz"))
    assert (refused.http_status, refused.retry_after) == (503, 1.0)


async def test_docs(client: httpx.AsyncClient) -> None:
    page = (await client.get("/docs")).text
    files = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert any("swagger-ui" in file for file in files)
    for file in files:  # all of them here: the page needs no internet
        assert (await client.get(file)).status_code == httpx.codes.OK, file
    assert (await client.get("/openapi.json")).json()["info"]["title"] == "cab-forecast"


@pytest.mark.parametrize(
    ("method", "path", "status", "reason"),
    [
        ("GET", "/nowhere", 404, "NO_SUCH_ADDRESS"),
        ("GET", "/v1/models/a/b", 404, "NO_SUCH_ADDRESS"),
        ("GET", "/v1/predict", 405, "METHOD_NOT_ALLOWED"),
        ("DELETE", "/v1/models", 405, "METHOD_NOT_ALLOWED"),
        ("GET", "/v1/models/%00%ff", 404, "UNKNOWN_MODEL"),
    ],
)
async def test_wrong_addresses(
    client: httpx.AsyncClient, method: str, path: str, status: int, reason: str
) -> None:
    response = await client.request(method, path)
    error = from_problem(response)
    assert (error.http_status, error.reason) == (status, reason)
    assert status != 405 or response.headers["allow"]


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"content-type": "text/plain"}, 415),
        ({"content-encoding": "gzip"}, 415),
        ({"accept": "text/html"}, 406),
        ({"Request-Timeout": "soon"}, 422),
        ({"Request-Timeout": "-1"}, 422),
    ],
)
async def test_headers_refused(client: httpx.AsyncClient, headers: dict[str, str], status: int) -> None:
    response = await client.post("/v1/predict", content=as_json(make_request()), headers=headers)
    assert from_problem(response).http_status == status


async def test_json_faults_name_their_field(client: httpx.AsyncClient) -> None:
    response = await client.post("/v1/predict", content=b'{"time": 1, "agents": [{"colour": "red"}]}')
    assert from_problem(response).faults == [("agents[0].colour", "no such field")]
    response = await client.post("/v1/predict", content=b"{")
    assert from_problem(response).faults[0][0] == "body"


async def test_nan_in_json_is_a_bad_field(client: httpx.AsyncClient) -> None:
    response = await client.post("/v1/predict", content=b'{"time": "NaN"}')
    assert from_problem(response).faults == [("time", "must be a finite number")]


async def test_large_bodies_are_refused_even_in_chunks(client: httpx.AsyncClient) -> None:
    async def chunks() -> AsyncIterator[bytes]:
        for _ in range(30):
            yield b" " * 1000

    refused = await client.post("/v1/predict", content=chunks())
    assert from_problem(refused).http_status == 413
    assert from_problem(await client.post("/v1/predict", content=b" " * 30_000)).reason == "TOO_LARGE"


async def test_challenge() -> None:
    async with running(api_tokens=("x",)) as server, httpx.AsyncClient() as client:
        base = f"http://{server.http_address}"
        pages = ("/metrics", "/docs", "/openapi.json")  # browsers ask for the key as a password
        for path in ("/v1/models", "/v1/models/kalman", *pages):
            refused = await client.get(base + path)
            assert refused.status_code == 401
            ways = refused.headers["www-authenticate"]
            assert ways.endswith("Bearer")
            assert ways.startswith("Basic ") is (path in pages)
            assert (await client.get(base + path, headers={"authorization": "bearer x"})).status_code == 200
        for path in ("/livez", "/readyz"):
            assert (await client.get(base + path)).status_code == 200
