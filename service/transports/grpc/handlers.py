"""The contract's services as gRPC handlers."""

import functools
from contextlib import ExitStack

import grpc
from google.protobuf.message import Message

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from service.predict.pipeline import DataPlane
from service.predict.request_reader import LARGE_BYTES, EncodedRequest, RequestLimits, read_protobuf
from service.settings import Settings
from service.telemetry.metrics import Metrics
from service.transports.grpc.calls import Calls, Context
from service.transports.grpc.consistency import CONSISTENCY_SERVICE, ConsistencyHandlers

PREDICTION_SERVICE = pb.DESCRIPTOR.services_by_name["PredictionService"].full_name
MODEL_SERVICE = models_pb.DESCRIPTOR.services_by_name["ModelService"].full_name
SERVICES = (PREDICTION_SERVICE, MODEL_SERVICE, CONSISTENCY_SERVICE)
"""Full names of all."""


class Handlers:
    """What each method calls."""

    def __init__(self, dataplane: DataPlane, metrics: Metrics, settings: Settings) -> None:
        self._dataplane = dataplane
        self._calls = Calls(metrics, settings)
        self._consistency = ConsistencyHandlers(dataplane, self._calls)
        self._read_request = functools.partial(read_protobuf, limits=RequestLimits.from_settings(settings))

    def generic(self) -> "list[grpc.GenericRpcHandler[bytes, bytes]]":
        """For ``server.add_generic_rpc_handlers``."""
        handlers = {
            PREDICTION_SERVICE: {"Predict": self._calls.raw("Predict", self._predict)},
            MODEL_SERVICE: self._of_models(),
            CONSISTENCY_SERVICE: self._consistency.methods(),
        }
        return [grpc.method_handlers_generic_handler(name, handlers[name]) for name in SERVICES]

    async def _predict(self, body: bytes, context: Context) -> Message:
        held = ExitStack()
        call = held.enter_context(self._dataplane.accept(context.time_remaining()))
        # Not when this returns: the answer is yet to be sent, however slowly the client takes it
        context.add_done_callback(lambda _: held.close())
        return await self._dataplane.predict(EncodedRequest(body, self._read_request, LARGE_BYTES), call)

    def _of_models(self) -> "dict[str, grpc.RpcMethodHandler[bytes, bytes]]":
        unary, plane = self._calls.unary, self._dataplane
        return {
            "ListModels": unary("ListModels", models_pb.ListModelsRequest, plane.list_models),
            "GetModel": unary("GetModel", models_pb.GetModelRequest, plane.get_model),
        }
