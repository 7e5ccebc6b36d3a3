"""gRPC besides Predict: health, reflection, models, limits."""

from collections.abc import AsyncIterator

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.model_service_pb2_grpc import ModelServiceStub
from cab.forecast.v1.prediction_service_pb2_grpc import PredictionServiceStub
from service.server import Server
from tests.service.fakes import FakeForecaster
from tests.service.requests import make_request
from tests.service.servers import CallError, call_grpc, running

SERVICES = [
    "",
    "cab.forecast.v1.PredictionService",
    "cab.forecast.v1.ModelService",
    "cab.forecast.v1.ConsistencyService",
    "cab.forecast.v1.SceneService",
    "cab.forecast.v1.AdminService",
]


@pytest.fixture
async def server() -> AsyncIterator[Server]:
    async with running(FakeForecaster(), api_tokens=("token",)) as made:
        yield made


@pytest.fixture
async def channel(server: Server) -> AsyncIterator[grpc.aio.Channel]:
    async with grpc.aio.insecure_channel(server.grpc_address) as made:
        yield made


FORESEE = "/cab.forecast.v1.PredictionService/Foresee"
TOKEN = (("authorization", "Bearer token"),)


async def test_generated_stubs(channel: grpc.aio.Channel) -> None:
    response = await PredictionServiceStub(channel).Predict(make_request(2), metadata=TOKEN)
    assert isinstance(response, pb.PredictResponse)
    models = ModelServiceStub(channel)
    listed = await models.ListModels(models_pb.ListModelsRequest(), metadata=TOKEN)
    assert "kalman" in [model.name for model in listed.models]
    got = await models.GetModel(models_pb.GetModelRequest(name="fake"), metadata=TOKEN)
    assert got.model.is_default
    with pytest.raises(grpc.aio.AioRpcError) as caught:
        await models.GetModel(models_pb.GetModelRequest(name="nobody"), metadata=TOKEN)
    assert caught.value.code() is grpc.StatusCode.NOT_FOUND


async def test_health_needs_no_token_and_follows_the_server(
    server: Server, channel: grpc.aio.Channel
) -> None:
    health = health_pb2_grpc.HealthStub(channel)
    statuses = health_pb2.HealthCheckResponse
    for name in SERVICES:
        assert (await health.Check(health_pb2.HealthCheckRequest(service=name))).status == statuses.SERVING
    server._grpc.set_serving(False)
    for name in SERVICES:
        assert (
            await health.Check(health_pb2.HealthCheckRequest(service=name))
        ).status == statuses.NOT_SERVING


async def test_reflection(channel: grpc.aio.Channel) -> None:
    stub = reflection_pb2_grpc.ServerReflectionStub(channel)
    request = reflection_pb2.ServerReflectionRequest(list_services="")
    # Nothing is sent: a message that meets the refusal would fail with INTERNAL
    assert await stub.ServerReflectionInfo().code() is grpc.StatusCode.UNAUTHENTICATED
    [answer] = [each async for each in stub.ServerReflectionInfo(iter([request]), metadata=TOKEN)]
    names = {service.name for service in answer.list_services_response.service}
    assert names >= {*SERVICES[1:], "grpc.health.v1.Health"}


async def test_unknown_methods(channel: grpc.aio.Channel) -> None:
    for metadata in (TOKEN, ()):
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await channel.unary_unary(FORESEE, None, None)(b"", metadata=metadata)
        assert caught.value.code() is grpc.StatusCode.UNIMPLEMENTED


async def test_what_grpc_itself_refuses_for_its_size() -> None:
    async with running(max_request_bytes=1024) as server:
        with pytest.raises(CallError) as caught:
            await call_grpc(server, b"\0" * 10_000)
        assert caught.value.code == "RESOURCE_EXHAUSTED"


async def test_large_answers_go_out() -> None:
    async with running(FakeForecaster(modes=25), max_samples_per_call=100_000) as server:
        response = await call_grpc(server, make_request(100, samples=400))
        assert response.ByteSize() > 4 * 2**20
