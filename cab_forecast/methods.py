"""The remote methods, described once for both transports."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar
from urllib.parse import quote, urlencode

from google.protobuf.message import Message

from cab.forecast.v1.consistency_service_pb2 import (
    GetAgentConsistencyRequest,
    GetAgentConsistencyResponse,
    GetSceneConsistencyRequest,
    GetSceneConsistencyResponse,
    ListModelConsistencyRequest,
    ListModelConsistencyResponse,
    ResetSceneRequest,
    ResetSceneResponse,
    WatchSceneRequest,
    WatchSceneResponse,
)
from cab.forecast.v1.model_service_pb2 import (
    GetModelRequest,
    GetModelResponse,
    ListModelsRequest,
    ListModelsResponse,
)
from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse

Request = TypeVar("Request", bound=Message)
Response = TypeVar("Response", bound=Message)


@dataclass(frozen=True)
class Method(Generic[Request, Response]):
    """One remote method."""

    rpc: str
    """Full gRPC name, ``/package.Service/Method``."""
    verb: Literal["GET", "POST"]
    """HTTP verb; GET sends no body, what it asks for is in the path and its query."""
    path: Callable[[Request], str]
    """HTTP path below the endpoint, with the query."""
    response: type[Response]


def _with_query(path: str) -> Callable[[Message], str]:
    """The path with all that is set in a request of scalars as its query."""

    def address(request: Message) -> str:
        query = urlencode({field.name: value for field, value in request.ListFields()}, quote_via=quote)
        return f"{path}?{query}" if query else path

    return address


PREDICT: Method[PredictRequest, PredictResponse] = Method(
    "/cab.forecast.v1.PredictionService/Predict", "POST", lambda request: "/v1/predict", PredictResponse
)
LIST_MODELS: Method[ListModelsRequest, ListModelsResponse] = Method(
    "/cab.forecast.v1.ModelService/ListModels", "GET", lambda request: "/v1/models", ListModelsResponse
)
GET_MODEL: Method[GetModelRequest, GetModelResponse] = Method(
    "/cab.forecast.v1.ModelService/GetModel",
    "GET",
    lambda request: f"/v1/models/{quote(request.name, safe='@')}",
    GetModelResponse,
)
GET_AGENT_CONSISTENCY: Method[GetAgentConsistencyRequest, GetAgentConsistencyResponse] = Method(
    "/cab.forecast.v1.ConsistencyService/GetAgentConsistency",
    "GET",
    _with_query("/v1/consistency/agent"),
    GetAgentConsistencyResponse,
)
GET_SCENE_CONSISTENCY: Method[GetSceneConsistencyRequest, GetSceneConsistencyResponse] = Method(
    "/cab.forecast.v1.ConsistencyService/GetSceneConsistency",
    "GET",
    _with_query("/v1/consistency/scene"),
    GetSceneConsistencyResponse,
)
LIST_MODEL_CONSISTENCY: Method[ListModelConsistencyRequest, ListModelConsistencyResponse] = Method(
    "/cab.forecast.v1.ConsistencyService/ListModelConsistency",
    "GET",
    _with_query("/v1/consistency/models"),
    ListModelConsistencyResponse,
)
RESET_SCENE: Method[ResetSceneRequest, ResetSceneResponse] = Method(
    "/cab.forecast.v1.ConsistencyService/ResetScene",
    "POST",
    lambda request: "/v1/consistency/reset",
    ResetSceneResponse,
)
WATCH_SCENE: Method[WatchSceneRequest, WatchSceneResponse] = Method(
    "/cab.forecast.v1.ConsistencyService/WatchScene",
    "GET",
    _with_query("/v1/consistency/events"),
    WatchSceneResponse,
)
"""Answers with a stream."""


def get_model_request(name: str) -> GetModelRequest:
    """A request for one model.

    Raises:
        ValueError: the name is empty.
    """
    if not name:
        raise ValueError("the model's name is empty")
    return GetModelRequest(name=name)
