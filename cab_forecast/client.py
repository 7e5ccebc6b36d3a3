"""The blocking client, over gRPC or REST."""

from os import PathLike
from types import TracebackType
from typing import Self

import tenacity

from cab.forecast.v1.consistency_service_pb2 import (
    GetAgentConsistencyRequest,
    GetSceneConsistencyRequest,
    GetSceneConsistencyResponse,
    InstantConsistency,
    ListModelConsistencyRequest,
    ModelConsistency,
    ResetSceneRequest,
    WatchSceneRequest,
    WatchSceneResponse,
)
from cab.forecast.v1.model_service_pb2 import ListModelsRequest, Model
from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse
from cab_forecast.connecting import DEFAULT_RETRIES, DEFAULT_TIMEOUT, ClientSettings, open_transport
from cab_forecast.endpoints import DEFAULT_ENDPOINT
from cab_forecast.methods import (
    GET_AGENT_CONSISTENCY,
    GET_MODEL,
    GET_SCENE_CONSISTENCY,
    LIST_MODEL_CONSISTENCY,
    LIST_MODELS,
    PREDICT,
    RESET_SCENE,
    WATCH_SCENE,
    Method,
    Request,
    Response,
    get_model_request,
)
from cab_forecast.streams import Stream
from cab_forecast.timing import RETRY, WAIT, Budget, stop
from cab_forecast.transport import Encoding


class Client:
    """A blocking client, usable from several threads.

    Overload, a draining server, a track memory that does not answer and lost connections are retried, other
    errors are not. Asking twice does no harm: of one request the server remembers one thing.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        token: str | None = None,
        timeout: float = DEFAULT_TIMEOUT,
        retries: int = DEFAULT_RETRIES,
        *,
        encoding: Encoding = "protobuf",
        ca_file: str | PathLike[str] | None = None,
    ) -> None:
        """Connects at the first call.

        Args:
            endpoint: ``grpc://host:port``, ``grpcs://``, ``http://`` or ``https://``; bare ``host:port``
                is gRPC.
            token: bearer token; over ``grpc://`` and ``http://`` it travels in clear.
            timeout: s for a call, its retries included; the server is told what is left of it.
            retries: how often a call is tried again at most.
            encoding: ``protobuf`` or ``json`` for REST bodies.
            ca_file: PEM certificates to trust instead of the system's.

        Raises:
            ValueError: an argument is out of its range.
            OSError: the certificates cannot be read.
        """
        self._settings = ClientSettings(endpoint, token, timeout, retries, encoding=encoding, ca_file=ca_file)
        self._transport = open_transport(self._settings.connection)

    def predict(self, request: PredictRequest, timeout: float | None = None) -> PredictResponse:
        """Forecasts all agents of a scene.

        Args:
            request: see ``cab_forecast.predict_request``.
            timeout: s; None: the client's.

        Raises:
            ForecastError: there is no answer; its subclass says why.
        """
        return self._call(PREDICT, request, timeout)

    def list_models(self, timeout: float | None = None) -> list[Model]:
        """Every model that is loaded, by name and version.

        Raises:
            ForecastError: there is no answer; its subclass says why.
        """
        return list(self._call(LIST_MODELS, ListModelsRequest(), timeout).models)

    def get_model(self, name: str, timeout: float | None = None) -> Model:
        """One model.

        Args:
            name: ``name`` (its newest version) or ``name@version``.
            timeout: s; None: the client's.

        Raises:
            NotFound: no loaded model has that name.
            ForecastError: there is no answer; its subclass says why.
            ValueError: the name is empty.
        """
        return self._call(GET_MODEL, get_model_request(name), timeout).model

    def agent_consistency(
        self, scene_id: str, agent_id: str, window: float | None = None, timeout: float | None = None
    ) -> list[InstantConsistency]:
        """An agent's observations of the last seconds, and what was forecast for them; by ascending time.

        Args:
            scene_id: of the requests that it was in.
            agent_id: as in those.
            window: s back from its newest observation; None: 2 s.
            timeout: s; None: the client's.

        Raises:
            UnknownTrack: the server remembers nothing of it.
            TrackingUnavailable: its memory does not answer.
            ForecastError: there is no answer; its subclass says why.
        """
        request = GetAgentConsistencyRequest(scene_id=scene_id, agent_id=agent_id, window=window or 0.0)
        return list(self._call(GET_AGENT_CONSISTENCY, request, timeout).instants)

    def scene_consistency(self, scene_id: str, timeout: float | None = None) -> GetSceneConsistencyResponse:
        """The newest observation of every agent of a scene, and its sums by model.

        Args:
            scene_id: of the requests.
            timeout: s; None: the client's.

        Raises:
            UnknownTrack: the server remembers nothing of it.
            TrackingUnavailable: its memory does not answer.
            ForecastError: there is no answer; its subclass says why.
        """
        return self._call(GET_SCENE_CONSISTENCY, GetSceneConsistencyRequest(scene_id=scene_id), timeout)

    def model_consistency(self, timeout: float | None = None) -> list[ModelConsistency]:
        """What was settled by model, over the life of the server's process.

        Raises:
            ForecastError: there is no answer; its subclass says why.
        """
        return list(self._call(LIST_MODEL_CONSISTENCY, ListModelConsistencyRequest(), timeout).models)

    def reset_scene(self, scene_id: str, timeout: float | None = None) -> int:
        """Makes the server forget a scene; how many agents it knew. (A retry finds none left.)

        Raises:
            TrackingUnavailable: its memory does not answer.
            ForecastError: there is no answer; its subclass says why.
        """
        return self._call(RESET_SCENE, ResetSceneRequest(scene_id=scene_id), timeout).agents

    def watch_scene(self, scene_id: str, timeout: float | None = None) -> Stream[WatchSceneResponse]:
        """What is found out about a scene from now on, until the server drains or the stream is closed.

        Args:
            scene_id: of the requests.
            timeout: s for it to begin; None: the client's. It goes on for as long as it likes.

        Raises:
            TrackingUnavailable: the server's memory does not answer.
            Overloaded: too many watch.
            ForecastError: it does not begin; its subclass says why. Later its iteration raises them.
        """
        budget = self._settings.budget(timeout)
        request = WatchSceneRequest(scene_id=scene_id)
        stream: Stream[WatchSceneResponse] = self._attempts(budget)(
            self._transport.open, WATCH_SCENE, request, budget
        )
        return stream

    def close(self) -> None:
        """Frees the connections; calls after it raise RuntimeError."""
        self._settings.closed = True
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _call(self, method: Method[Request, Response], request: Request, timeout: float | None) -> Response:
        budget = self._settings.budget(timeout)
        answer: Response = self._attempts(budget)(self._transport.call, method, request, budget)
        return answer

    def _attempts(self, budget: Budget) -> tenacity.Retrying:
        return tenacity.Retrying(
            stop=stop(self._settings.retries, budget), wait=WAIT, retry=RETRY, reraise=True
        )
