"""The contract's methods over HTTP, and the one place where their errors become problems."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

import structlog
from google.protobuf.message import Message
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from service.api.auth import Tokens
from service.api.boundary import to_service_error
from service.api.rest.codec import parse_json, parse_protobuf, to_json
from service.api.rest.negotiation import Format, answer_format, request_format, timeout
from service.api.rest.problem import problem_response
from service.core.dataplane import DataPlane
from service.errors import TooLarge
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)
_T = TypeVar("_T")
_CLIENT_CLOSED_REQUEST = 499
"""What is logged, though nobody is there to read it."""


class Endpoints:
    """The handlers of ``/v1``."""

    def __init__(
        self, dataplane: DataPlane, metrics: Metrics, tokens: Tokens, max_request_bytes: int
    ) -> None:
        self._dataplane = dataplane
        self._metrics = metrics
        self._tokens = tokens
        self._max_bytes = max_request_bytes

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
        arrived = asyncio.get_running_loop().time()
        incoming = request_format(request.headers)
        outgoing = answer_format(request.headers, preferred=incoming)
        seconds = timeout(request.headers)
        deadline = None if seconds is None else arrived + seconds
        self._dataplane.check()  # JSON takes its time, which a call that is refused anyway should not cost
        body = await self._read_body(request)
        parse = parse_json if incoming is Format.JSON else parse_protobuf
        message = await asyncio.to_thread(parse, pb.PredictRequest, body)
        answer = await _unless_disconnected(request, self._dataplane.predict(message, deadline))
        return await asyncio.to_thread(_respond, answer, outgoing)

    async def _list_models(self, request: Request) -> Response:
        outgoing = answer_format(request.headers, preferred=Format.JSON)
        return _respond(await self._dataplane.list_models(models_pb.ListModelsRequest()), outgoing)

    async def _get_model(self, request: Request) -> Response:
        outgoing = answer_format(request.headers, preferred=Format.JSON)
        name: str = request.path_params["name"]
        return _respond(await self._dataplane.get_model(models_pb.GetModelRequest(name=name)), outgoing)

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
