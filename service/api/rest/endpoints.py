"""The contract's methods over HTTP, and the one place where their errors become problems."""

import asyncio
import functools
from collections.abc import Awaitable, Callable
from typing import TypeVar

import structlog
from google.protobuf.message import Message
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from cab.forecast.v1 import model_service_pb2 as models_pb
from service.api.auth import Tokens
from service.api.boundary import to_service_error
from service.api.rest import requests
from service.api.rest.codec import to_json
from service.api.rest.negotiation import Format, answer_format, request_format, timeout
from service.api.rest.problem import problem_response
from service.api.rest.sending import held
from service.core import wire
from service.core.dataplane import DataPlane
from service.core.incoming import LARGE_BYTES, Encoded
from service.core.sizes import Sizes
from service.errors import TooLarge
from service.settings import Settings
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)
_T = TypeVar("_T")
_CLIENT_CLOSED_REQUEST = 499
"""What is logged, though nobody is there to read it."""


class Endpoints:
    """The handlers of ``/v1``."""

    def __init__(self, dataplane: DataPlane, metrics: Metrics, settings: Settings) -> None:
        self._dataplane = dataplane
        self._metrics = metrics
        self._tokens = Tokens(settings.api_tokens)
        self._max_bytes = settings.max_request_bytes
        self._sizes = Sizes.of(settings)

    async def predict(self, request: Request) -> Response:
        """POST /v1/predict."""
        return await self._call("Predict", request, self._predict)

    async def list_models(self, request: Request) -> Response:
        """GET /v1/models."""
        return await self._call("ListModels", request, self._list_models)

    async def get_model(self, request: Request) -> Response:
        """GET /v1/models/{name}."""
        return await self._call("GetModel", request, self._get_model)

    async def _call(
        self, method: str, request: Request, behavior: Callable[[Request], Awaitable[Response]]
    ) -> Response:
        with self._metrics.call("rest", method) as call:
            try:
                self._tokens.check(request.headers.get("authorization"))
                response = await behavior(request)
            except ClientDisconnect:
                _log.debug("call", transport="rest", method=method, code=call.code)
                return Response(status_code=_CLIENT_CLOSED_REQUEST)
            except Exception as exception:
                error = to_service_error(exception, method)
                call.code = error.code
                _log.debug("call", transport="rest", method=method, code=error.code, reason=error.reason)
                return problem_response(error)
            call.code = "OK"
            _log.debug("call", transport="rest", method=method, code="OK")
            return response

    async def _predict(self, request: Request) -> Response:
        incoming = request_format(request.headers)
        outgoing = answer_format(request.headers, preferred=incoming)
        call = held(request).enter_context(self._dataplane.accept(timeout(request.headers)))
        async with call.in_time():
            body = await self._read_body(request)
        encoded = self._encoded(body, incoming)
        answer = await _unless_disconnected(request, self._dataplane.predict(encoded, call))
        return await asyncio.to_thread(_respond, answer, outgoing)

    async def _list_models(self, request: Request) -> Response:
        outgoing = answer_format(request.headers, preferred=Format.JSON)
        return _respond(await self._dataplane.list_models(models_pb.ListModelsRequest()), outgoing)

    async def _get_model(self, request: Request) -> Response:
        outgoing = answer_format(request.headers, preferred=Format.JSON)
        name: str = request.path_params["name"]
        return _respond(await self._dataplane.get_model(models_pb.GetModelRequest(name=name)), outgoing)

    def _encoded(self, body: bytes, incoming: Format) -> Encoded:
        if incoming is Format.JSON:  # never quick
            return Encoded(body, functools.partial(requests.read_request, sizes=self._sizes))
        return Encoded(body, functools.partial(wire.read_request, sizes=self._sizes), LARGE_BYTES)

    async def _read_body(self, request: Request) -> bytes:
        """The body, refused as soon as it is known to be too large, however it is sent."""
        declared = request.headers.get("content-length", "")
        if declared.isdecimal() and int(declared) > self._max_bytes:
            raise self._too_large()
        body = bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > self._max_bytes:
                raise self._too_large()
        return bytes(body)

    def _too_large(self) -> TooLarge:
        return TooLarge(f"the body has more than {self._max_bytes} bytes")


def _respond(message: Message, outgoing: Format) -> Response:
    body = to_json(message) if outgoing is Format.JSON else message.SerializeToString()
    return Response(body, media_type=outgoing.value)


async def _unless_disconnected(request: Request, work: Awaitable[_T]) -> _T:
    """What the work gives; it is cancelled when the client goes away first.

    Raises:
        ClientDisconnect: it did.
    """
    task = asyncio.ensure_future(work)
    watch = asyncio.create_task(_disconnected(request))
    try:
        await asyncio.wait({task, watch}, return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise ClientDisconnect
        return task.result()
    finally:
        task.cancel()
        watch.cancel()
        await asyncio.gather(task, watch, return_exceptions=True)


async def _disconnected(request: Request) -> None:
    """Returns when the client has gone away; the body was read before."""
    while (await request.receive())["type"] != "http.disconnect":
        pass
