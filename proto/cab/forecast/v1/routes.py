"""Route table of the contract: the gRPC name of each method, and the verb and path that REST gives it.

The table is written by hand, beside the generated code: the .proto files carry no HTTP annotations. The
server's handlers, the OpenAPI document and the client all read it.
"""

import re
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar
from urllib.parse import quote, urlencode

from google.protobuf.message import Message

from cab.forecast.v1.admin_service_pb2 import ReloadModelsRequest, ReloadModelsResponse
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
from cab.forecast.v1.explanation_service_pb2 import ExplainRequest, ExplainResponse
from cab.forecast.v1.model_service_pb2 import (
    GetModelRequest,
    GetModelResponse,
    GetVersionRequest,
    GetVersionResponse,
    ListModelsRequest,
    ListModelsResponse,
)
from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse
from cab.forecast.v1.scene_service_pb2 import (
    ListScenesRequest,
    ListScenesResponse,
    WatchForecastsRequest,
    WatchForecastsResponse,
)

Request = TypeVar("Request", bound=Message)
Response = TypeVar("Response", bound=Message)

PREDICTION_SERVICE = "cab.forecast.v1.PredictionService"
EXPLANATION_SERVICE = "cab.forecast.v1.ExplanationService"
MODEL_SERVICE = "cab.forecast.v1.ModelService"
CONSISTENCY_SERVICE = "cab.forecast.v1.ConsistencyService"
SCENE_SERVICE = "cab.forecast.v1.SceneService"
ADMIN_SERVICE = "cab.forecast.v1.AdminService"
SERVICES = (
    PREDICTION_SERVICE,
    EXPLANATION_SERVICE,
    MODEL_SERVICE,
    CONSISTENCY_SERVICE,
    SCENE_SERVICE,
    ADMIN_SERVICE,
)
"""Full names of all gRPC services of the contract."""

_PATH_PARAMETER = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True)
class Route(Generic[Request, Response]):
    """One method of the contract, and how both transports address it."""

    service: str
    """Full name of its gRPC service."""
    method: str
    verb: Literal["GET", "POST"]
    """HTTP verb. GET sends no body: the request is in the path and the query."""
    path: str
    """HTTP path below the endpoint; "{name}" stands for the request's field of that name."""
    request: type[Request]
    response: type[Response]
    streaming: bool = False
    """True if the response is a stream of messages (over REST: Server-Sent Events)."""

    @property
    def rpc(self) -> str:
        """Full gRPC name, ``/package.Service/Method``."""
        return f"/{self.service}/{self.method}"

    def target(self, request: Request) -> str:
        """Return the HTTP path of a request, with the query of a GET.

        Args:
            request: of a GET, a message of scalars; the fields that are set go into path and query.
        """
        path = _PATH_PARAMETER.sub(lambda match: _segment(getattr(request, match[1])), self.path)
        if self.verb == "POST":
            return path
        in_path = _PATH_PARAMETER.findall(self.path)
        fields = {field.name: value for field, value in request.ListFields() if field.name not in in_path}
        return f"{path}?{urlencode(fields, quote_via=quote)}" if fields else path


def _segment(value: str) -> str:
    """Return a value as a segment of a path; HTTP libraries would drop one that is "." or ".."."""
    return quote(value, safe="@") if value.strip(".") else value.replace(".", "%2E")


PREDICT: Route[PredictRequest, PredictResponse] = Route(
    PREDICTION_SERVICE, "Predict", "POST", "/v1/predict", PredictRequest, PredictResponse
)
EXPLAIN: Route[ExplainRequest, ExplainResponse] = Route(
    EXPLANATION_SERVICE, "Explain", "POST", "/v1/explain", ExplainRequest, ExplainResponse
)
LIST_MODELS: Route[ListModelsRequest, ListModelsResponse] = Route(
    MODEL_SERVICE, "ListModels", "GET", "/v1/models", ListModelsRequest, ListModelsResponse
)
GET_MODEL: Route[GetModelRequest, GetModelResponse] = Route(
    MODEL_SERVICE, "GetModel", "GET", "/v1/models/{name}", GetModelRequest, GetModelResponse
)
GET_VERSION: Route[GetVersionRequest, GetVersionResponse] = Route(
    MODEL_SERVICE, "GetVersion", "GET", "/v1/version", GetVersionRequest, GetVersionResponse
)
GET_AGENT_CONSISTENCY: Route[GetAgentConsistencyRequest, GetAgentConsistencyResponse] = Route(
    CONSISTENCY_SERVICE,
    "GetAgentConsistency",
    "GET",
    "/v1/consistency/agent",
    GetAgentConsistencyRequest,
    GetAgentConsistencyResponse,
)
GET_SCENE_CONSISTENCY: Route[GetSceneConsistencyRequest, GetSceneConsistencyResponse] = Route(
    CONSISTENCY_SERVICE,
    "GetSceneConsistency",
    "GET",
    "/v1/consistency/scene",
    GetSceneConsistencyRequest,
    GetSceneConsistencyResponse,
)
LIST_MODEL_CONSISTENCY: Route[ListModelConsistencyRequest, ListModelConsistencyResponse] = Route(
    CONSISTENCY_SERVICE,
    "ListModelConsistency",
    "GET",
    "/v1/consistency/models",
    ListModelConsistencyRequest,
    ListModelConsistencyResponse,
)
WATCH_SCENE: Route[WatchSceneRequest, WatchSceneResponse] = Route(
    CONSISTENCY_SERVICE,
    "WatchScene",
    "GET",
    "/v1/consistency/events",
    WatchSceneRequest,
    WatchSceneResponse,
    streaming=True,
)
RESET_SCENE: Route[ResetSceneRequest, ResetSceneResponse] = Route(
    CONSISTENCY_SERVICE,
    "ResetScene",
    "POST",
    "/v1/consistency/reset",
    ResetSceneRequest,
    ResetSceneResponse,
)
LIST_SCENES: Route[ListScenesRequest, ListScenesResponse] = Route(
    SCENE_SERVICE, "ListScenes", "GET", "/v1/scenes", ListScenesRequest, ListScenesResponse
)
WATCH_FORECASTS: Route[WatchForecastsRequest, WatchForecastsResponse] = Route(
    SCENE_SERVICE,
    "WatchForecasts",
    "GET",
    "/v1/scenes/{scene_id}/forecasts/watch",
    WatchForecastsRequest,
    WatchForecastsResponse,
    streaming=True,
)
RELOAD_MODELS: Route[ReloadModelsRequest, ReloadModelsResponse] = Route(
    ADMIN_SERVICE,
    "ReloadModels",
    "POST",
    "/v1/admin/reload-models",
    ReloadModelsRequest,
    ReloadModelsResponse,
)

ROUTES: tuple[Route[Any, Any], ...] = (
    PREDICT,
    EXPLAIN,
    LIST_MODELS,
    GET_MODEL,
    GET_VERSION,
    GET_AGENT_CONSISTENCY,
    GET_SCENE_CONSISTENCY,
    LIST_MODEL_CONSISTENCY,
    WATCH_SCENE,
    RESET_SCENE,
    LIST_SCENES,
    WATCH_FORECASTS,
    RELOAD_MODELS,
)
"""All methods of the contract."""
