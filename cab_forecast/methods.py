"""The remote methods, described once for both transports."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Literal, TypeVar
from urllib.parse import quote

from google.protobuf.message import Message

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
    """HTTP verb; GET sends no body, what it asks for is in the path."""
    path: Callable[[Request], str]
    """HTTP path below the endpoint."""
    response: type[Response]


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
