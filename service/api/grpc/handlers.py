"""The contract's methods as gRPC handlers, and the one place where their errors become statuses."""

import functools
from collections.abc import Awaitable, Callable
from contextlib import ExitStack
from typing import Any, TypeVar

import grpc
import structlog
from google.protobuf.message import DecodeError, Message

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from service.api.boundary import to_service_error
from service.api.grpc.status import abort
from service.core.dataplane import DataPlane
from service.core.incoming import LARGE_BYTES, Encoded
from service.core.sizes import Sizes
from service.core.wire import read_request
from service.errors import BadField, TooLarge
from service.settings import Settings
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)
_Request = TypeVar("_Request", bound=Message)
_Context = Any  # grpc.aio.ServicerContext is generic in messages that are bytes here

PREDICTION_SERVICE = pb.DESCRIPTOR.services_by_name["PredictionService"].full_name
MODEL_SERVICE = models_pb.DESCRIPTOR.services_by_name["ModelService"].full_name


class Handlers:
    """Handlers that take and give bytes: a message that is too large or no message at all then fails
    like any other bad call, with details, instead of somewhere inside gRPC without."""

    def __init__(self, dataplane: DataPlane, metrics: Metrics, settings: Settings) -> None:
        self._dataplane = dataplane
        self._metrics = metrics
        self._max_bytes = settings.max_request_bytes
        self._read_request = functools.partial(read_request, sizes=Sizes.of(settings))

    def generic(self) -> "list[grpc.GenericRpcHandler[bytes, bytes]]":
        """For ``server.add_generic_rpc_handlers``."""
        prediction = {"Predict": self._unary("Predict", self._predict)}
        model = {
            "ListModels": self._unary("ListModels", self._list_models),
            "GetModel": self._unary("GetModel", self._get_model),
        }
        return [
            grpc.method_handlers_generic_handler(PREDICTION_SERVICE, prediction),
            grpc.method_handlers_generic_handler(MODEL_SERVICE, model),
        ]

    async def _predict(self, body: bytes, context: _Context) -> Message:
        held = ExitStack()
        call = held.enter_context(self._dataplane.accept(context.time_remaining()))
        # Not when this returns: the answer is yet to be sent, however slowly the client takes it
        context.add_done_callback(lambda _: held.close())
        return await self._dataplane.predict(Encoded(body, self._read_request, LARGE_BYTES), call)

    async def _list_models(self, body: bytes, _: _Context) -> Message:
        return await self._dataplane.list_models(_parse(models_pb.ListModelsRequest, body))

    async def _get_model(self, body: bytes, _: _Context) -> Message:
        return await self._dataplane.get_model(_parse(models_pb.GetModelRequest, body))

    def _unary(
        self, method: str, behavior: Callable[[bytes, _Context], Awaitable[Message]]
    ) -> "grpc.RpcMethodHandler[bytes, bytes]":
        async def handle(body: bytes, context: _Context) -> bytes:
            # gRPC cancels this coroutine when the client goes away or its deadline passes, and with it
            # whatever the call has in the queue.
            with self._metrics.call("grpc", method) as call:
                try:
                    if len(body) > self._max_bytes:
                        raise TooLarge(
                            f"the request has {len(body)} bytes; at most {self._max_bytes} are accepted"
                        )
                    answer = (await behavior(body, context)).SerializeToString()
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


def _parse(request_type: type[_Request], body: bytes) -> _Request:
    """A small message: its fields are scalars."""
    try:
        return request_type.FromString(body)
    except DecodeError as error:
        raise BadField("body", f"is no {request_type.DESCRIPTOR.full_name}") from error
