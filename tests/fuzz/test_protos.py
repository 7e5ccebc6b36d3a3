"""Generated messages to a running server, which must never cause internal errors or wrong numbers."""

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import grpc
import httpx
import numpy as np
import pytest
from google.protobuf.message import Message
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import consistency_service_pb2_grpc as consistency_grpc
from cab.forecast.v1 import explanation_service_pb2 as explanation_pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import model_service_pb2_grpc as models_grpc
from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1 import prediction_service_pb2_grpc as pb_grpc
from service.server import Server
from tests.fuzz.strategies import consistency_requests, model_requests, requests, watch_requests

pytestmark = [
    pytest.mark.fuzz,
    pytest.mark.filterwarnings("ignore:Generating overly large repr"),  # of messages with packed maps
]

CASES = settings(
    max_examples=1200,
    deadline=None,
    suppress_health_check=[
        HealthCheck.function_scoped_fixture,
        HealthCheck.too_slow,
        HealthCheck.data_too_large,
    ],
)
FEWER = settings(CASES, max_examples=400)
FEW = settings(CASES, max_examples=50)
EXPECTED = {
    grpc.StatusCode.OK,
    grpc.StatusCode.INVALID_ARGUMENT,
    grpc.StatusCode.NOT_FOUND,
    grpc.StatusCode.RESOURCE_EXHAUSTED,
}
NAMES = ["", "", "cab", "kalman", "constant-velocity-yaw", "constant-acceleration-yaw-rate", "cab@0"]
PROTOBUF = {"content-type": "application/x-protobuf", "accept": "application/x-protobuf"}


def damaged(request: pb.PredictRequest) -> st.SearchStrategy[bytes]:
    """Generate a message with one byte changed, or truncated."""
    good = request.SerializeToString()
    if not good:
        return st.just(b"")
    at = st.integers(0, len(good) - 1)
    return st.one_of(
        st.tuples(at, st.integers(0, 255)).map(lambda c: good[: c[0]] + bytes([c[1]]) + good[c[0] + 1 :]),
        at.map(lambda end: good[:end]),
    )


@pytest.fixture(scope="module")
def channel(server: Server) -> Iterator[grpc.Channel]:
    """Open a channel to the server."""
    with grpc.insecure_channel(server.grpc_address) as channel:
        yield channel


@pytest.fixture(scope="module")
def http(server: Server) -> Iterator[httpx.Client]:
    """Open an HTTP client of the server."""
    with httpx.Client(base_url=f"http://{server.http_address}", timeout=30) as client:
        yield client


@pytest.fixture(scope="module")
def seen() -> Iterator[Counter[str]]:
    """Count how calls ended; a run whose requests are all refused tests little."""
    counts: Counter[str] = Counter()
    yield counts
    assert counts["OK"] > 0.4 * counts.total(), counts
    assert counts["forecasts"] > 0.5 * counts["OK"], counts


@CASES
@given(request=requests(NAMES))
def test_predict(channel: grpc.Channel, seen: Counter[str], request: pb.PredictRequest) -> None:
    try:
        response = pb_grpc.PredictionServiceStub(channel).Predict(request, timeout=30)
    except grpc.RpcError as error:
        seen[expected_code(error)] += 1
        return
    seen["OK"] += 1
    seen["forecasts"] += any(len(forecast.means) > 0 for forecast in response.forecasts)
    check(request, response)


@FEWER
@given(request=requests(NAMES))
def test_both_transports_answer_alike(
    channel: grpc.Channel, http: httpx.Client, request: pb.PredictRequest
) -> None:
    request.options.seed = 1  # without one, every call draws its own
    request.ClearField("scene_id")  # the second call would be answered by what is remembered of the first
    code = grpc.StatusCode.OK
    by_grpc = pb.PredictResponse()
    try:
        by_grpc = pb_grpc.PredictionServiceStub(channel).Predict(request, timeout=30)
    except grpc.RpcError as error:
        code = error.code()
    answer = http.post("/v1/predict", content=request.SerializeToString(), headers=PROTOBUF)
    if code is not grpc.StatusCode.OK:
        assert code in EXPECTED
        assert answer.json()["code"] == code.name
        return
    assert answer.status_code == httpx.codes.OK, answer.text
    by_rest = pb.PredictResponse.FromString(answer.content)
    for response in (by_grpc, by_rest):
        response.ClearField("timing")
    assert by_grpc.SerializeToString(deterministic=True) == by_rest.SerializeToString(deterministic=True)


@FEWER
@given(body=st.one_of(st.binary(max_size=400), requests(NAMES).flatmap(damaged)))
def test_noise_for_a_message(http: httpx.Client, body: bytes) -> None:
    answer = http.post("/v1/predict", content=body, headers=PROTOBUF)
    assert answer.status_code < httpx.codes.INTERNAL_SERVER_ERROR, answer.text
    if answer.status_code == httpx.codes.OK:
        check(pb.PredictRequest.FromString(body), pb.PredictResponse.FromString(answer.content))


@FEWER
@given(body=requests(NAMES).flatmap(damaged))
def test_explanations(channel: grpc.Channel, body: bytes) -> None:
    """A request of Predict is one of Explain, but for its scene and options."""
    explain = channel.unary_unary("/cab.forecast.v1.ExplanationService/Explain", None, None)
    try:
        answer = explain(body, timeout=30)
    except grpc.RpcError as error:
        expected_code(error)
        return
    for one in explanation_pb.ExplainResponse.FromString(answer).explanations:
        assert np.isfinite([one.state.nearer, one.map.nearer, one.neighbors.nearer]).all()


@FEWER
@given(request=model_requests(NAMES))
def test_models(channel: grpc.Channel, request: models_pb.GetModelRequest) -> None:
    try:
        response = models_grpc.ModelServiceStub(channel).GetModel(request, timeout=30)
    except grpc.RpcError as error:
        expected_code(error)
        return
    assert response.model.name


@FEWER
@given(request=consistency_requests())
def test_consistency(channel: grpc.Channel, request: Message) -> None:
    stub = consistency_grpc.ConsistencyServiceStub(channel)
    calls: dict[type[Message], Any] = {
        consistency_pb.GetAgentConsistencyRequest: stub.GetAgentConsistency,
        consistency_pb.GetSceneConsistencyRequest: stub.GetSceneConsistency,
        consistency_pb.ResetSceneRequest: stub.ResetScene,
    }
    try:
        calls[type(request)](request, timeout=30)
    except grpc.RpcError as error:
        expected_code(error)


@FEW
@given(request=watch_requests())
def test_watching(channel: grpc.Channel, request: consistency_pb.WatchSceneRequest) -> None:
    call = consistency_grpc.ConsistencyServiceStub(channel).WatchScene(request, timeout=0.02)
    with pytest.raises(grpc.RpcError) as caught:
        list(call)
    assert caught.value.code() in {grpc.StatusCode.DEADLINE_EXCEEDED, grpc.StatusCode.INVALID_ARGUMENT}


def expected_code(error: grpc.RpcError) -> str:
    """Return the code of the error, after checking that a request can cause it."""
    code: grpc.StatusCode = error.code()
    assert code in EXPECTED, error
    return code.name


def check(request: pb.PredictRequest, response: pb.PredictResponse) -> None:
    """Check what must hold for every response."""
    steps = response.steps
    forecasts = response.forecasts
    wanted = {n for n, agent in enumerate(request.agents) if not agent.HasField("predict") or agent.predict}
    invalid = {int(f.field.split("[")[1].split("]")[0]) for f in forecasts if f.field}
    assert [f.agent_id for f in forecasts] == [request.agents[n].id for n in sorted(wanted | invalid)]
    for forecast in forecasts:
        if forecast.status == pb.FORECAST_STATUS_INVALID:
            assert forecast.detail
            assert forecast.field.startswith("agents[")
            assert not forecast.means
            assert not forecast.weights
            continue
        modes = len(forecast.weights)
        assert modes > 0
        assert len(forecast.mode_ids) == modes
        assert len(forecast.means) == modes * steps * 2
        assert len(forecast.covariances) == modes * steps * 3
        assert len(forecast.samples) == request.options.samples * steps * 2
        assert forecast.most_likely_mode == int(np.argmax(forecast.weights))
        numbers = [*forecast.weights, *forecast.means, *forecast.covariances, *forecast.samples]
        assert all(map(math.isfinite, numbers))
        assert math.isclose(sum(forecast.weights) + forecast.remaining_weight, 1, abs_tol=1e-5)
        xx, xy, yy = np.reshape(forecast.covariances, (-1, 3)).T
        assert (xx > 0).all()
        assert (yy > 0).all()
        assert (xy**2 <= xx * yy * (1 + 1e-5)).all()
        if forecast.status != pb.FORECAST_STATUS_OK:
            assert forecast.detail
