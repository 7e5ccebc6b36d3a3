"""The contract's methods as gRPC handlers, and the one place where their errors become statuses."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import grpc
import structlog
from google.protobuf.message import DecodeError, Message

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from service.api.boundary import to_service_error
from service.api.grpc.status import abort
from service.core.dataplane import DataPlane
from service.errors import BadField, TooLarge
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)
_Request = TypeVar("_Request", bound=Message)
_Context = Any  # grpc.aio.ServicerContext is generic in messages that are bytes here

PREDICTION_SERVICE = pb.DESCRIPTOR.services_by_name["PredictionService"].full_name
MODEL_SERVICE = models_pb.DESCRIPTOR.services_by_name["ModelService"].full_name


class Handlers:
    """Handlers that take and give bytes: a message that is too large or no message at all then fails
    like any other bad call, with details, instead of somewhere inside gRPC without."""

    def __init__(self, dataplane: DataPlane, metrics: Metrics, max_request_bytes: int) -> None:
        self._dataplane = dataplane
        self._metrics = metrics
        self._max_bytes = max_request_bytes

    def generic(self) -> "list[grpc.GenericRpcHandler[bytes, bytes]]":
        """For ``server.add_generic_rpc_handlers``."""
        prediction = {"Predict": self._unary("Predict", pb.PredictRequest, self._predict)}
        model = {
            "ListModels": self._unary("ListModels", models_pb.ListModelsRequest, self._list_models),
            "GetModel": self._unary("GetModel", models_pb.GetModelRequest, self._get_model),
        }
        return [
            grpc.method_handlers_generic_handler(PREDICTION_SERVICE, prediction),
            grpc.method_handlers_generic_handler(MODEL_SERVICE, model),
        ]

    async def _predict(self, request: pb.PredictRequest, context: _Context) -> Message:
        remaining = context.time_remaining()
        deadline = None if remaining is None else asyncio.get_running_loop().time() + remaining
        return await self._dataplane.predict(request, deadline)

    async def _list_models(self, request: models_pb.ListModelsRequest, _: _Context) -> Message:
        return await self._dataplane.list_models(request)

    async def _get_model(self, request: models_pb.GetModelRequest, _: _Context) -> Message:
        return await self._dataplane.get_model(request)

    def _unary(
        self,
        method: str,
        request_type: type[_Request],
        behavior: Callable[[_Request, _Context], Awaitable[Message]],
    ) -> "grpc.RpcMethodHandler[bytes, bytes]":
        async def handle(body: bytes, context: _Context) -> bytes:
            # gRPC cancels this coroutine when the client goes away or its deadline passes, and with it
            # whatever the call has in the queue.
            with self._metrics.call("grpc", method) as call:
                try:
                    request = self._parse(request_type, body)
                    answer = (await behavior(request, context)).SerializeToString()
                except Exception as exception:
                    error = to_service_error(exception, method)
                    call.code = error.code
                    _log.debug("call", transport="grpc", method=method, code=error.code, reason=error.reason)
                    await abort(context, error)
                    raise  # not reached: abort raises
                call.code = "OK"
                _log.debug("call", transport="grpc", method=method, code="OK")
                return answer

        return grpc.unary_unary_rpc_method_handler(handle)

    def _parse(self, request_type: type[_Request], body: bytes) -> _Request:
        if len(body) > self._max_bytes:
            raise TooLarge(f"the request has {len(body)} bytes; at most {self._max_bytes} are accepted")
        try:
            return request_type.FromString(body)
        except DecodeError as error:
            raise BadField("body", f"is no {request_type.DESCRIPTOR.full_name}") from error
