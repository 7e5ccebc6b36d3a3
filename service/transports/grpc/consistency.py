"""ConsistencyService as gRPC handlers."""

from collections.abc import AsyncIterator

import grpc

from cab.forecast.v1 import consistency_service_pb2 as pb
from service.predict.pipeline import DataPlane
from service.transports.grpc.calls import Calls

CONSISTENCY_SERVICE = pb.DESCRIPTOR.services_by_name["ConsistencyService"].full_name


class ConsistencyHandlers:
    """What each method calls."""

    def __init__(self, dataplane: DataPlane, calls: Calls) -> None:
        self._dataplane = dataplane
        self._calls = calls

    def methods(self) -> "dict[str, grpc.RpcMethodHandler[bytes, bytes]]":
        """Handlers by the name of their method."""
        unary, stream = self._calls.unary, self._calls.stream
        return {
            "GetAgentConsistency": unary(
                "GetAgentConsistency", pb.GetAgentConsistencyRequest, self._get_agent
            ),
            "GetSceneConsistency": unary(
                "GetSceneConsistency", pb.GetSceneConsistencyRequest, self._get_scene
            ),
            "ListModelConsistency": unary(
                "ListModelConsistency", pb.ListModelConsistencyRequest, self._list_models
            ),
            "ResetScene": unary("ResetScene", pb.ResetSceneRequest, self._reset_scene),
            "WatchScene": stream("WatchScene", pb.WatchSceneRequest, self._watch_scene),
        }

    async def _get_agent(self, request: pb.GetAgentConsistencyRequest) -> pb.GetAgentConsistencyResponse:
        return await self._dataplane.consistency.get_agent(request)

    async def _get_scene(self, request: pb.GetSceneConsistencyRequest) -> pb.GetSceneConsistencyResponse:
        return await self._dataplane.consistency.get_scene(request)

    async def _list_models(self, request: pb.ListModelConsistencyRequest) -> pb.ListModelConsistencyResponse:
        return await self._dataplane.consistency.list_models(request)

    async def _reset_scene(self, request: pb.ResetSceneRequest) -> pb.ResetSceneResponse:
        return await self._dataplane.consistency.reset_scene(request)

    def _watch_scene(self, request: pb.WatchSceneRequest) -> AsyncIterator[pb.WatchSceneResponse]:
        return self._dataplane.consistency.watch_scene(request)
