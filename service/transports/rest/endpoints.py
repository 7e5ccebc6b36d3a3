"""Forecasts and models over HTTP."""

import asyncio
import functools

from starlette.requests import Request
from starlette.responses import Response

from cab.forecast.v1 import model_service_pb2 as models_pb
from service.predict.pipeline import DataPlane
from service.predict.request_reader import LARGE_BYTES, EncodedRequest, RequestLimits, read_protobuf
from service.settings import Settings
from service.transports.rest import json_request
from service.transports.rest.calls import Calls, respond, unless_disconnected
from service.transports.rest.negotiation import Format, answer_format, request_format, timeout
from service.transports.rest.sending import held


class Endpoints:
    """The handlers of ``/v1/predict`` and ``/v1/models``."""

    def __init__(self, dataplane: DataPlane, calls: Calls, settings: Settings) -> None:
        self._dataplane = dataplane
        self._calls = calls
        self._limits = RequestLimits.from_settings(settings)

    async def predict(self, request: Request) -> Response:
        """POST /v1/predict."""
        return await self._calls.answer("Predict", request, self._predict)

    async def list_models(self, request: Request) -> Response:
        """GET /v1/models."""
        return await self._calls.answer("ListModels", request, self._list_models)

    async def get_model(self, request: Request) -> Response:
        """GET /v1/models/{name}."""
        return await self._calls.answer("GetModel", request, self._get_model)

    async def _predict(self, request: Request) -> Response:
        incoming = request_format(request.headers)
        outgoing = answer_format(request.headers, preferred=incoming)
        call = held(request).enter_context(self._dataplane.accept(timeout(request.headers)))
        async with call.in_time():
            body = await self._calls.read_body(request)
        encoded = self._encoded(body, incoming)
        answer = await unless_disconnected(request.receive, self._dataplane.predict(encoded, call))
        return await asyncio.to_thread(respond, answer, outgoing)

    async def _list_models(self, request: Request) -> Response:
        outgoing = answer_format(request.headers, preferred=Format.JSON)
        return respond(await self._dataplane.list_models(models_pb.ListModelsRequest()), outgoing)

    async def _get_model(self, request: Request) -> Response:
        outgoing = answer_format(request.headers, preferred=Format.JSON)
        name: str = request.path_params["name"]
        return respond(await self._dataplane.get_model(models_pb.GetModelRequest(name=name)), outgoing)

    def _encoded(self, body: bytes, incoming: Format) -> EncodedRequest:
        if incoming is Format.JSON:  # never quick
            return EncodedRequest(body, functools.partial(json_request.read_request, limits=self._limits))
        return EncodedRequest(body, functools.partial(read_protobuf, limits=self._limits), LARGE_BYTES)
