"""Clients over gRPC or REST: a blocking one, and one for asyncio."""

from os import PathLike
from types import TracebackType
from typing import Any, Self

import tenacity

from cab.forecast.v1.admin_service_pb2 import ReloadModelsRequest, ReloadModelsResponse
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
from cab.forecast.v1.explanation_service_pb2 import ExplainRequest, ExplainResponse
from cab.forecast.v1.model_service_pb2 import (
    GetModelRequest,
    GetVersionRequest,
    GetVersionResponse,
    ListModelsRequest,
    Model,
)
from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse
from cab.forecast.v1.routes import (
    EXPLAIN,
    GET_AGENT_CONSISTENCY,
    GET_MODEL,
    GET_SCENE_CONSISTENCY,
    GET_VERSION,
    LIST_MODEL_CONSISTENCY,
    LIST_MODELS,
    LIST_SCENES,
    PREDICT,
    RELOAD_MODELS,
    RESET_SCENE,
    WATCH_FORECASTS,
    WATCH_SCENE,
    Request,
    Response,
    Route,
)
from cab.forecast.v1.scene_service_pb2 import (
    ListScenesRequest,
    SceneSummary,
    WatchForecastsRequest,
    WatchForecastsResponse,
)
from cab_forecast.connection import (
    DEFAULT_RETRIES,
    DEFAULT_TIMEOUT,
    AsyncTransport,
    ClientSettings,
    Connection,
    Encoding,
    Transport,
    from_variables,
)
from cab_forecast.endpoints import DEFAULT_ENDPOINT
from cab_forecast.errors import DeadlineExceeded, UnknownRaster
from cab_forecast.rasters import RasterDigests, SceneRequest
from cab_forecast.streams import AsyncStream, OpenStream, Stream
from cab_forecast.timing import RETRY, WAIT, Budget, stop_condition


class Client:
    """A blocking client, usable from several threads.

    Overload, a draining server, an unavailable track memory and lost connections are retried; other errors
    are not. Retries are safe: the server records a repeated request only once.
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
        certificate_file: str | PathLike[str] | None = None,
        key_file: str | PathLike[str] | None = None,
        map_by_digest: bool = True,
    ) -> None:
        """Create a client; it connects at the first call.

        Args:
            endpoint: ``grpc://host:port``, ``grpcs://``, ``http://`` or ``https://``; bare ``host:port``
                is gRPC.
            token: API key or bearer token; over ``grpc://`` and ``http://`` it is sent unencrypted.
            timeout: seconds for a call, retries included; the server is told the remaining time.
            retries: max number of retries of a call.
            encoding: ``protobuf`` or ``json`` for REST bodies.
            ca_file: PEM certificates to trust instead of the system's.
            certificate_file: PEM certificate of this client, for servers that require one.
            key_file: PEM private key of that certificate.
            map_by_digest: whether to name a scene raster of 4 kB or more by its digest if it was sent before.
                One that the server does not have is sent whole in the same call. False: requests are sent
                as they are.

        Raises:
            ValueError: an argument is out of range.
            OSError: the certificates cannot be read.
        """
        self._settings = ClientSettings(
            endpoint,
            token,
            timeout,
            retries,
            encoding=encoding,
            ca_file=ca_file,
            certificate_file=certificate_file,
            key_file=key_file,
        )
        self._transport = _connect(self._settings.connection)
        self._rasters = RasterDigests() if map_by_digest else None

    @classmethod
    def from_environment(cls, **arguments: Any) -> Self:
        """Create a client whose endpoint, key and certificates environment variables set.

        The variables are CAB_FORECAST_ENDPOINT, CAB_FORECAST_TOKEN, CAB_FORECAST_CA_FILE,
        CAB_FORECAST_CERTIFICATE_FILE and CAB_FORECAST_KEY_FILE.

        Args:
            arguments: arguments of the client, which go before the variables.

        Raises:
            ValueError: an argument is out of range.
            OSError: the certificates cannot be read.
        """
        return cls(**(from_variables() | arguments))

    def predict(self, request: PredictRequest, timeout: float | None = None) -> PredictResponse:
        """Forecast the agents of a scene.

        Args:
            request: the request, see ``cab_forecast.predict_request``.
            timeout: seconds; None: the client's.

        Raises:
            ForecastError: the call failed; the subclass says why.
        """
        return self._send_scene(PREDICT, request, timeout)

    def explain(self, request: ExplainRequest, timeout: float | None = None) -> ExplainResponse:
        """Explain the forecasts of agents of a scene: what they owe to own state, map and neighbours.

        Servers make explanations while no forecast waits for the model, so give them time.

        Args:
            request: the request, see ``cab_forecast.explain_request``.
            timeout: seconds; None: the client's.

        Raises:
            ForecastError: the call failed; the subclass says why.
        """
        return self._send_scene(EXPLAIN, request, timeout)

    def list_models(self, timeout: float | None = None) -> list[Model]:
        """Return all loaded models, by name and version.

        Raises:
            ForecastError: the call failed; the subclass says why.
        """
        return list(self._call(LIST_MODELS, ListModelsRequest(), timeout).models)

    def get_model(self, name: str, timeout: float | None = None) -> Model:
        """Return one model.

        Args:
            name: ``name`` (its newest version) or ``name@version``.
            timeout: seconds; None: the client's.

        Raises:
            NotFound: no loaded model has that name.
            ForecastError: the call failed; the subclass says why.
            ValueError: the name is empty.
        """
        return self._call(GET_MODEL, _get_model_request(name), timeout).model

    def get_version(self, timeout: float | None = None) -> GetVersionResponse:
        """Return the version of the server.

        Raises:
            ForecastError: the call failed; the subclass says why.
        """
        return self._call(GET_VERSION, GetVersionRequest(), timeout)

    def agent_consistency(
        self, scene_id: str, agent_id: str, window: float | None = None, timeout: float | None = None
    ) -> list[InstantConsistency]:
        """Return an agent's recent observations, by time, with how well they were forecast.

        Args:
            scene_id: the scene, as in the Predict requests.
            agent_id: the agent, as in the Predict requests.
            window: seconds back from the agent's newest observation; None: 2 s.
            timeout: seconds; None: the client's.

        Raises:
            UnknownTrack: the server has no track of that agent.
            TrackingUnavailable: the track memory does not respond.
            ForecastError: the call failed; the subclass says why.
        """
        request = GetAgentConsistencyRequest(scene_id=scene_id, agent_id=agent_id, window=window or 0.0)
        return list(self._call(GET_AGENT_CONSISTENCY, request, timeout).instants)

    def scene_consistency(self, scene_id: str, timeout: float | None = None) -> GetSceneConsistencyResponse:
        """Return the newest observation of every agent of a scene, and aggregates by model.

        Args:
            scene_id: the scene, as in the Predict requests.
            timeout: seconds; None: the client's.

        Raises:
            UnknownTrack: the server has no track of that scene.
            TrackingUnavailable: the track memory does not respond.
            ForecastError: the call failed; the subclass says why.
        """
        return self._call(GET_SCENE_CONSISTENCY, GetSceneConsistencyRequest(scene_id=scene_id), timeout)

    def model_consistency(self, timeout: float | None = None) -> list[ModelConsistency]:
        """Return consistency aggregates by model, since the server's process started.

        Raises:
            ForecastError: the call failed; the subclass says why.
        """
        return list(self._call(LIST_MODEL_CONSISTENCY, ListModelConsistencyRequest(), timeout).models)

    def reset_scene(self, scene_id: str, timeout: float | None = None) -> int:
        """Delete the tracks of a scene; return the number of agents deleted.

        The number is 0 if a first attempt succeeded but its response was lost.

        Raises:
            TrackingUnavailable: the track memory does not respond.
            ForecastError: the call failed; the subclass says why.
        """
        return self._call(RESET_SCENE, ResetSceneRequest(scene_id=scene_id), timeout).agents

    def watch_scene(self, scene_id: str, timeout: float | None = None) -> Stream[WatchSceneResponse]:
        """Stream a scene's consistency from now on, until the server drains or the stream is closed.

        Args:
            scene_id: the scene, as in the Predict requests.
            timeout: seconds until the stream starts; None: the client's. The stream itself has no timeout.

        Raises:
            TrackingUnavailable: the track memory does not respond.
            Overloaded: the server has too many watchers.
            ForecastError: the stream did not start; the subclass says why. Later errors are raised by its
                iteration.
        """
        return self._open(WATCH_SCENE, WatchSceneRequest(scene_id=scene_id), timeout)

    def list_scenes(self, timeout: float | None = None) -> list[SceneSummary]:
        """Return the scenes that are being forecast, the one that was called last first.

        Raises:
            ForecastError: the call failed; the subclass says why.
        """
        return list(self._call(LIST_SCENES, ListScenesRequest(), timeout).scenes)

    def watch_forecasts(self, scene_id: str, timeout: float | None = None) -> Stream[WatchForecastsResponse]:
        """Stream a scene's maps and forecasts from now on, until the server drains or the stream is closed.

        Args:
            scene_id: the scene, as in the Predict requests.
            timeout: seconds until the stream starts; None: the client's. The stream itself has no timeout.

        Raises:
            Overloaded: the server has too many watchers.
            ForecastError: the stream did not start; the subclass says why. Later errors are raised by its
                iteration.
        """
        return self._open(WATCH_FORECASTS, WatchForecastsRequest(scene_id=scene_id), timeout)

    def reload_models(self, timeout: float | None = None) -> ReloadModelsResponse:
        """Make the server read its folder of models again: what took over, what is gone, what was refused.

        The server goes on with the reload if the timeout passes meanwhile.

        Raises:
            Unauthenticated: the token does not permit it.
            ForecastError: the call failed; the subclass says why. With the reason ``RELOAD_REFUSED`` the
                models are as they were.
        """
        return self._call(RELOAD_MODELS, ReloadModelsRequest(), timeout)

    def close(self) -> None:
        """Close the connections; later calls raise RuntimeError."""
        self._settings.closed = True
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _send_scene(
        self, route: Route[SceneRequest, Response], request: SceneRequest, timeout: float | None
    ) -> Response:
        """Send a request whose scene raster the server may have."""
        budget = self._settings.budget(timeout)
        if self._rasters is None:
            return self._send(route, request, budget)
        sending = self._rasters.prepare(request)
        try:
            response = self._send(route, sending.request, budget)
        except UnknownRaster:
            if not sending.named:
                raise
            sending = self._rasters.whole(request, sending)
            response = self._send(route, sending.request, budget)
        self._rasters.answered(sending)
        return response

    def _call(self, route: Route[Request, Response], request: Request, timeout: float | None) -> Response:
        return self._send(route, request, self._settings.budget(timeout))

    def _send(self, route: Route[Request, Response], request: Request, budget: Budget) -> Response:
        try:
            response: Response = self._retrying(budget)(self._transport.call, route, request, budget)
        except DeadlineExceeded as error:
            raise budget.late(error) from error
        return response

    def _open(
        self, route: Route[Request, Response], request: Request, timeout: float | None
    ) -> Stream[Response]:
        budget = self._settings.budget(timeout)
        stream: Stream[Response] = self._retrying(budget)(self._transport.open, route, request, budget)
        return stream

    def _retrying(self, budget: Budget) -> tenacity.Retrying:
        return tenacity.Retrying(
            stop=stop_condition(self._settings.retries, budget), wait=WAIT, retry=RETRY, reraise=True
        )


class AsyncClient:
    """``Client`` for asyncio: the same arguments, calls and errors; used within one event loop."""

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        token: str | None = None,
        timeout: float = DEFAULT_TIMEOUT,
        retries: int = DEFAULT_RETRIES,
        *,
        encoding: Encoding = "protobuf",
        ca_file: str | PathLike[str] | None = None,
        certificate_file: str | PathLike[str] | None = None,
        key_file: str | PathLike[str] | None = None,
        map_by_digest: bool = True,
    ) -> None:
        """See ``Client``."""
        self._settings = ClientSettings(
            endpoint,
            token,
            timeout,
            retries,
            encoding=encoding,
            ca_file=ca_file,
            certificate_file=certificate_file,
            key_file=key_file,
        )
        # Opened at the first call, because a channel belongs to the event loop that it is created in.
        self._transport: AsyncTransport | None = None
        self._rasters = RasterDigests() if map_by_digest else None

    @classmethod
    def from_environment(cls, **arguments: Any) -> Self:
        """See ``Client.from_environment``."""
        return cls(**(from_variables() | arguments))

    async def predict(self, request: PredictRequest, timeout: float | None = None) -> PredictResponse:  # noqa: ASYNC109 - it goes to the server, too
        """See ``Client.predict``."""
        return await self._send_scene(PREDICT, request, timeout)

    async def explain(self, request: ExplainRequest, timeout: float | None = None) -> ExplainResponse:  # noqa: ASYNC109
        """See ``Client.explain``."""
        return await self._send_scene(EXPLAIN, request, timeout)

    async def list_models(self, timeout: float | None = None) -> list[Model]:  # noqa: ASYNC109
        """See ``Client.list_models``."""
        return list((await self._call(LIST_MODELS, ListModelsRequest(), timeout)).models)

    async def get_model(self, name: str, timeout: float | None = None) -> Model:  # noqa: ASYNC109
        """See ``Client.get_model``."""
        return (await self._call(GET_MODEL, _get_model_request(name), timeout)).model

    async def get_version(self, timeout: float | None = None) -> GetVersionResponse:  # noqa: ASYNC109
        """See ``Client.get_version``."""
        return await self._call(GET_VERSION, GetVersionRequest(), timeout)

    async def agent_consistency(
        self,
        scene_id: str,
        agent_id: str,
        window: float | None = None,
        timeout: float | None = None,  # noqa: ASYNC109
    ) -> list[InstantConsistency]:
        """See ``Client.agent_consistency``."""
        request = GetAgentConsistencyRequest(scene_id=scene_id, agent_id=agent_id, window=window or 0.0)
        return list((await self._call(GET_AGENT_CONSISTENCY, request, timeout)).instants)

    async def scene_consistency(
        self,
        scene_id: str,
        timeout: float | None = None,  # noqa: ASYNC109
    ) -> GetSceneConsistencyResponse:
        """See ``Client.scene_consistency``."""
        return await self._call(GET_SCENE_CONSISTENCY, GetSceneConsistencyRequest(scene_id=scene_id), timeout)

    async def model_consistency(self, timeout: float | None = None) -> list[ModelConsistency]:  # noqa: ASYNC109
        """See ``Client.model_consistency``."""
        return list((await self._call(LIST_MODEL_CONSISTENCY, ListModelConsistencyRequest(), timeout)).models)

    async def reset_scene(self, scene_id: str, timeout: float | None = None) -> int:  # noqa: ASYNC109
        """See ``Client.reset_scene``."""
        return (await self._call(RESET_SCENE, ResetSceneRequest(scene_id=scene_id), timeout)).agents

    async def reload_models(self, timeout: float | None = None) -> ReloadModelsResponse:  # noqa: ASYNC109
        """See ``Client.reload_models``."""
        return await self._call(RELOAD_MODELS, ReloadModelsRequest(), timeout)

    def watch_scene(self, scene_id: str, timeout: float | None = None) -> AsyncStream[WatchSceneResponse]:
        """See ``Client.watch_scene``.

        Unlike there, the call starts with ``async with`` or the first message, and raises errors then.
        """
        return self._open(WATCH_SCENE, WatchSceneRequest(scene_id=scene_id), timeout)

    async def list_scenes(self, timeout: float | None = None) -> list[SceneSummary]:  # noqa: ASYNC109
        """See ``Client.list_scenes``."""
        return list((await self._call(LIST_SCENES, ListScenesRequest(), timeout)).scenes)

    def watch_forecasts(
        self, scene_id: str, timeout: float | None = None
    ) -> AsyncStream[WatchForecastsResponse]:
        """See ``Client.watch_forecasts``.

        Unlike there, the call starts with ``async with`` or the first message, and raises errors then.
        """
        return self._open(WATCH_FORECASTS, WatchForecastsRequest(scene_id=scene_id), timeout)

    async def close(self) -> None:
        """See ``Client.close``."""
        self._settings.closed = True
        if self._transport is not None:
            await self._transport.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    async def _send_scene(
        self,
        route: Route[SceneRequest, Response],
        request: SceneRequest,
        timeout: float | None,  # noqa: ASYNC109
    ) -> Response:
        """Send a request whose scene raster the server may have."""
        budget = self._settings.budget(timeout)
        if self._rasters is None:
            return await self._send(route, request, budget)
        sending = self._rasters.prepare(request)
        try:
            response = await self._send(route, sending.request, budget)
        except UnknownRaster:
            if not sending.named:
                raise
            sending = self._rasters.whole(request, sending)
            response = await self._send(route, sending.request, budget)
        self._rasters.answered(sending)
        return response

    async def _call(
        self,
        route: Route[Request, Response],
        request: Request,
        timeout: float | None,  # noqa: ASYNC109
    ) -> Response:
        return await self._send(route, request, self._settings.budget(timeout))

    async def _send(self, route: Route[Request, Response], request: Request, budget: Budget) -> Response:
        transport = self._open_transport()
        try:
            response: Response = await self._retrying(budget)(transport.call, route, request, budget)
        except DeadlineExceeded as error:
            raise budget.late(error) from error
        return response

    def _open(
        self, route: Route[Request, Response], request: Request, timeout: float | None
    ) -> AsyncStream[Response]:
        async def start() -> OpenStream[Response]:
            budget = self._settings.budget(timeout)
            opened: OpenStream[Response] = await self._retrying(budget)(
                self._open_transport().open, route, request, budget
            )
            return opened

        return AsyncStream(start)

    def _open_transport(self) -> AsyncTransport:
        if self._transport is None:
            self._transport = _connect_async(self._settings.connection)
        return self._transport

    def _retrying(self, budget: Budget) -> tenacity.AsyncRetrying:
        return tenacity.AsyncRetrying(
            stop=stop_condition(self._settings.retries, budget), wait=WAIT, retry=RETRY, reraise=True
        )


def _get_model_request(name: str) -> GetModelRequest:
    if not name:  # it would be the path of the list
        raise ValueError("the model's name is empty")
    return GetModelRequest(name=name)


def _connect(connection: Connection) -> Transport:
    """Return the transport for an endpoint."""
    # Imported here, so that users of one transport do not load the other.
    if connection.endpoint.transport == "grpc":
        from cab_forecast.grpc_transport import GrpcTransport  # noqa: PLC0415

        return GrpcTransport(connection)
    from cab_forecast.rest_transport import RestTransport  # noqa: PLC0415

    return RestTransport(connection)


def _connect_async(connection: Connection) -> AsyncTransport:
    """Return the transport for an endpoint, for asyncio."""
    if connection.endpoint.transport == "grpc":
        from cab_forecast.grpc_transport import AsyncGrpcTransport  # noqa: PLC0415

        return AsyncGrpcTransport(connection)
    from cab_forecast.rest_transport import AsyncRestTransport  # noqa: PLC0415

    return AsyncRestTransport(connection)
