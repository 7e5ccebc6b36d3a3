"""The client for asyncio: the calls of the blocking one."""

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
from cab_forecast.connecting import DEFAULT_RETRIES, DEFAULT_TIMEOUT, ClientSettings, open_async_transport
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
from cab_forecast.streams import AsyncStream, Opened
from cab_forecast.timing import RETRY, WAIT, Budget, stop
from cab_forecast.transport import AsyncTransport, Encoding


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
    ) -> None:
        """As ``Client``."""
        self._settings = ClientSettings(endpoint, token, timeout, retries, encoding=encoding, ca_file=ca_file)
        # Opened at the first call: a channel belongs to the event loop that it is made in.
        self._transport: AsyncTransport | None = None

    async def predict(self, request: PredictRequest, timeout: float | None = None) -> PredictResponse:  # noqa: ASYNC109 - it goes to the server, too
        """As ``Client.predict``."""
        return await self._call(PREDICT, request, timeout)

    async def list_models(self, timeout: float | None = None) -> list[Model]:  # noqa: ASYNC109
        """As ``Client.list_models``."""
        return list((await self._call(LIST_MODELS, ListModelsRequest(), timeout)).models)

    async def get_model(self, name: str, timeout: float | None = None) -> Model:  # noqa: ASYNC109
        """As ``Client.get_model``."""
        return (await self._call(GET_MODEL, get_model_request(name), timeout)).model

    async def agent_consistency(
        self,
        scene_id: str,
        agent_id: str,
        window: float | None = None,
        timeout: float | None = None,  # noqa: ASYNC109
    ) -> list[InstantConsistency]:
        """As ``Client.agent_consistency``."""
        request = GetAgentConsistencyRequest(scene_id=scene_id, agent_id=agent_id, window=window or 0.0)
        return list((await self._call(GET_AGENT_CONSISTENCY, request, timeout)).instants)

    async def scene_consistency(
        self,
        scene_id: str,
        timeout: float | None = None,  # noqa: ASYNC109
    ) -> GetSceneConsistencyResponse:
        """As ``Client.scene_consistency``."""
        return await self._call(GET_SCENE_CONSISTENCY, GetSceneConsistencyRequest(scene_id=scene_id), timeout)

    async def model_consistency(self, timeout: float | None = None) -> list[ModelConsistency]:  # noqa: ASYNC109
        """As ``Client.model_consistency``."""
        return list((await self._call(LIST_MODEL_CONSISTENCY, ListModelConsistencyRequest(), timeout)).models)

    async def reset_scene(self, scene_id: str, timeout: float | None = None) -> int:  # noqa: ASYNC109
        """As ``Client.reset_scene``."""
        return (await self._call(RESET_SCENE, ResetSceneRequest(scene_id=scene_id), timeout)).agents

    def watch_scene(self, scene_id: str, timeout: float | None = None) -> AsyncStream[WatchSceneResponse]:
        """As ``Client.watch_scene``, but that it begins with ``async with`` or the first message asked for,
        and raises then what keeps it from it."""
        request = WatchSceneRequest(scene_id=scene_id)

        async def begin() -> Opened[WatchSceneResponse]:
            budget = self._settings.budget(timeout)
            opened: Opened[WatchSceneResponse] = await self._attempts(budget)(
                self._open_transport().open, WATCH_SCENE, request, budget
            )
            return opened

        return AsyncStream(begin)

    async def close(self) -> None:
        """As ``Client.close``."""
        self._settings.closed = True
        if self._transport is not None:
            await self._transport.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self.close()

    async def _call(
        self,
        method: Method[Request, Response],
        request: Request,
        timeout: float | None,  # noqa: ASYNC109
    ) -> Response:
        budget = self._settings.budget(timeout)
        transport = self._open_transport()
        answer: Response = await self._attempts(budget)(transport.call, method, request, budget)
        return answer

    def _open_transport(self) -> AsyncTransport:
        if self._transport is None:
            self._transport = open_async_transport(self._settings.connection)
        return self._transport

    def _attempts(self, budget: Budget) -> tenacity.AsyncRetrying:
        return tenacity.AsyncRetrying(
            stop=stop(self._settings.retries, budget), wait=WAIT, retry=RETRY, reraise=True
        )
