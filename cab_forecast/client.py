"""The clients: the same calls, blocking or for asyncio, over gRPC or REST."""

from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Self

import tenacity

from cab.forecast.v1.model_service_pb2 import GetModelRequest, ListModelsRequest, Model
from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse
from cab_forecast.endpoints import DEFAULT_ENDPOINT, parse_endpoint
from cab_forecast.methods import GET_MODEL, LIST_MODELS, PREDICT, Method, Request, Response
from cab_forecast.timing import RETRY, WAIT, Budget, stop
from cab_forecast.transport import AsyncTransport, Connection, Encoding, Transport

DEFAULT_TIMEOUT = 5.0
"""s for a call, retries included."""
DEFAULT_RETRIES = 2


class _Settings:
    """What a client was made with, checked."""

    def __init__(
        self,
        endpoint: str,
        token: str | None,
        timeout: float,
        retries: int,
        *,
        encoding: Encoding,
        ca_file: str | PathLike[str] | None,
    ) -> None:
        if retries < 0:
            raise ValueError(f"retries must not be negative, but is {retries}")
        if encoding not in ("protobuf", "json"):
            raise ValueError(f"encoding must be 'protobuf' or 'json', not {encoding!r}")
        Budget(timeout)  # refuses what is no timeout here rather than at the first call
        self.connection = Connection(
            parse_endpoint(endpoint), token, encoding, Path(ca_file) if ca_file is not None else None
        )
        if encoding == "json" and self.connection.endpoint.transport == "grpc":
            raise ValueError("encoding='json' is for http:// and https:// endpoints; gRPC speaks protobuf")
        self.timeout = timeout
        self.retries = retries
        self.closed = False

    def budget(self, timeout: float | None) -> Budget:
        """The time for one call."""
        if self.closed:
            raise RuntimeError("this client is closed")
        return Budget(self.timeout if timeout is None else timeout)


class Client:
    """A blocking client, usable from several threads.

    Overload, a draining server and lost connections are retried, other errors are not; a forecast
    depends on nothing but its request, so that asking twice does no harm.
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
        self._settings = _Settings(endpoint, token, timeout, retries, encoding=encoding, ca_file=ca_file)
        self._transport = _open(self._settings.connection)

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
        return self._call(GET_MODEL, _get_model_request(name), timeout).model

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
        attempts = tenacity.Retrying(
            stop=stop(self._settings.retries, budget), wait=WAIT, retry=RETRY, reraise=True
        )
        answer: Response = attempts(self._transport.call, method, request, budget)
        return answer


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
        self._settings = _Settings(endpoint, token, timeout, retries, encoding=encoding, ca_file=ca_file)
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
        return (await self._call(GET_MODEL, _get_model_request(name), timeout)).model

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
        if self._transport is None:
            self._transport = _open_async(self._settings.connection)
        attempts = tenacity.AsyncRetrying(
            stop=stop(self._settings.retries, budget), wait=WAIT, retry=RETRY, reraise=True
        )
        answer: Response = await attempts(self._transport.call, method, request, budget)
        return answer


def _open(connection: Connection) -> Transport:
    # Imported here: whoever speaks one transport needs not load the other.
    if connection.endpoint.transport == "grpc":
        from cab_forecast.grpc_transport import GrpcTransport  # noqa: PLC0415

        return GrpcTransport(connection)
    from cab_forecast.rest_transport import RestTransport  # noqa: PLC0415

    return RestTransport(connection)


def _open_async(connection: Connection) -> AsyncTransport:
    if connection.endpoint.transport == "grpc":
        from cab_forecast.grpc_transport import AsyncGrpcTransport  # noqa: PLC0415

        return AsyncGrpcTransport(connection)
    from cab_forecast.rest_transport import AsyncRestTransport  # noqa: PLC0415

    return AsyncRestTransport(connection)


def _get_model_request(name: str) -> GetModelRequest:
    if not name:
        raise ValueError("the model's name is empty")
    return GetModelRequest(name=name)
