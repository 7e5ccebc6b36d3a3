"""Consistency over HTTP."""

from collections.abc import AsyncIterator, Awaitable, Callable
from typing import TypeVar

from google.protobuf.message import Message
from starlette.requests import Request
from starlette.responses import Response

from cab.forecast.v1 import consistency_service_pb2 as pb
from service.predict.pipeline import DataPlane
from service.transports.messages import parse_message
from service.transports.rest.calls import Calls, respond
from service.transports.rest.codec import parse_json
from service.transports.rest.events import EventStream
from service.transports.rest.negotiation import Format, answer_format, request_format
from service.transports.rest.parameters import read_parameters

_Request = TypeVar("_Request", bound=Message)
_MAX_BYTES = 2**16
"""Of a request that holds an id; it is read on the event loop."""


class ConsistencyEndpoints:
    """The handlers of ``/v1/consistency``."""

    def __init__(self, dataplane: DataPlane, calls: Calls) -> None:
        self._dataplane = dataplane
        self._calls = calls

    async def get_agent(self, request: Request) -> Response:
        """GET /v1/consistency/agent."""
        plane = self._dataplane.consistency
        return await self._get("GetAgentConsistency", request, pb.GetAgentConsistencyRequest, plane.get_agent)

    async def get_scene(self, request: Request) -> Response:
        """GET /v1/consistency/scene."""
        plane = self._dataplane.consistency
        return await self._get("GetSceneConsistency", request, pb.GetSceneConsistencyRequest, plane.get_scene)

    async def list_models(self, request: Request) -> Response:
        """GET /v1/consistency/models."""
        plane = self._dataplane.consistency
        return await self._get(
            "ListModelConsistency", request, pb.ListModelConsistencyRequest, plane.list_models
        )

    async def reset_scene(self, request: Request) -> Response:
        """POST /v1/consistency/reset."""
        return await self._calls.answer("ResetScene", request, self._reset_scene)

    async def watch_scene(self, request: Request) -> Response:
        """GET /v1/consistency/events."""
        return EventStream(self._calls, "WatchScene", request, self._events)

    async def _get(
        self,
        method: str,
        request: Request,
        request_type: type[_Request],
        behavior: Callable[[_Request], Awaitable[Message]],
    ) -> Response:
        async def answer(request: Request) -> Response:
            outgoing = answer_format(request.headers, preferred=Format.JSON)
            return respond(await behavior(read_parameters(request_type, request.query_params)), outgoing)

        return await self._calls.answer(method, request, answer)

    async def _reset_scene(self, request: Request) -> Response:
        incoming = request_format(request.headers)
        outgoing = answer_format(request.headers, preferred=incoming)
        body = await self._calls.read_body(request, _MAX_BYTES)
        read = parse_json if incoming is Format.JSON else parse_message
        message = read(pb.ResetSceneRequest, body)
        return respond(await self._dataplane.consistency.reset_scene(message), outgoing)

    def _events(self, request: Request) -> AsyncIterator[Message]:
        return self._dataplane.consistency.watch_scene(
            read_parameters(pb.WatchSceneRequest, request.query_params)
        )
