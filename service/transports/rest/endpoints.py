"""REST endpoints of the contract's methods: from the HTTP request to the HTTP response."""

import asyncio
import functools
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractContextManager, ExitStack, aclosing
from typing import Any, TypeVar

import orjson
from google.protobuf.message import Message
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from cab.forecast.v1.explanation_service_pb2 import ExplainRequest
from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab.forecast.v1.routes import EXPLAIN, MODEL_SERVICE, PREDICT, Route
from service.access.caller import Grant
from service.access.gate import Gate
from service.access.scopes import scope_of
from service.errors import RequestTimeout, TooLarge
from service.predict.admission import Call
from service.predict.dataplane import DataPlane
from service.predict.request_reader import (
    LARGE_BYTES,
    EncodedRequest,
    RequestLimits,
    SceneRequest,
    read_protobuf,
)
from service.scenes.shared_message import SharedMessage
from service.settings import Settings
from service.transports.calls import STREAMS, UNARY_METHODS, CallRecorder, CallRecords, parse_message
from service.transports.intake import Intake
from service.transports.rest.codec import parse_json, read_query, read_request, to_json
from service.transports.rest.negotiation import (
    EVENT_STREAM,
    Format,
    check_events_accepted,
    request_format,
    response_format,
    timeout,
)
from service.transports.rest.problem import problem_response, to_problem
from service.transports.streams import HEARTBEAT, Event, encoded, with_idle_ticks

_SMALL_BYTES = 2**16
"""Limit of requests that hold no more than an id; they are parsed on the event loop."""
_CLIENT_CLOSED_REQUEST = 499
"""Status of a response that is never sent, because the client has disconnected."""
_EVENT_HEADERS = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}  # keep proxies from buffering
_EXIT_STACK = "forecast.exit_stack"
"""Key of the exit stack in the ASGI scope."""

_T = TypeVar("_T")
Endpoint = Callable[[Request], Awaitable[Response]]
Behavior = Callable[[Request, Grant], Awaitable[Response]]


class Endpoints:
    """The contract's methods as Starlette endpoints."""

    def __init__(
        self, dataplane: DataPlane, records: CallRecords, settings: Settings, intake: Intake, gate: Gate
    ) -> None:
        self._intake = intake
        self._gate = gate
        self._body_timeout = settings.body_timeout
        self._dataplane = dataplane
        self._records = records
        self._max_bytes = settings.max_request_bytes
        self._limits = RequestLimits.from_settings(settings)

    def by_route(self) -> dict[Route[Any, Any], Endpoint]:
        """Return the endpoint of each route."""
        endpoints: dict[Route[Any, Any], Endpoint] = {
            PREDICT: self._recorded(PREDICT, self._predict),
            EXPLAIN: self._recorded(EXPLAIN, self._explain),
        }
        for route in STREAMS:
            endpoints[route] = functools.partial(self._watch, route)
        for route in UNARY_METHODS:
            endpoints[route] = self._recorded(route, functools.partial(self._execute, route))
        return endpoints

    def _recorded(self, route: Route[Any, Any], behavior: Behavior) -> Endpoint:
        """Return an endpoint that authenticates, records the call, and responds to errors with a problem."""

        async def endpoint(request: Request) -> Response:
            with self._records.record(route.method) as recorder:
                try:
                    caller = self._gate.identify(request.headers.get("authorization"))
                    recorder.identified(caller)
                    caller.require(scope_of(route))
                    # Before the bounds that all share: what is beyond a key's own must not use them up
                    grant = exit_stack(request).enter_context(caller.call())
                    exit_stack(request).enter_context(self._intake.call())
                    response = await behavior(request, grant)
                except ClientDisconnect:
                    return Response(status_code=_CLIENT_CLOSED_REQUEST)
                except Exception as exception:
                    return problem_response(recorder.failed(exception))
                recorder.succeeded()
                return response

        return endpoint

    async def _predict(self, request: Request, grant: Grant) -> Response:
        plane = self._dataplane
        return await self._scene(PredictRequest, request, grant, plane.accept, plane.predict)

    async def _explain(self, request: Request, grant: Grant) -> Response:
        plane = self._dataplane
        return await self._scene(ExplainRequest, request, grant, plane.accept_explanation, plane.explain)

    async def _scene(
        self,
        kind: type[SceneRequest],
        request: Request,
        grant: Grant,
        accept: Callable[[float | None, Grant | None], AbstractContextManager[Call]],
        execute: Callable[[EncodedRequest[SceneRequest], Call], Awaitable[Message]],
    ) -> Response:
        """Execute a method whose request is a scene.

        Args:
            kind: type of the request.
            request: the HTTP request.
            grant: counts the agents of the request.
            accept: accepts the call.
            execute: executes it.
        """
        incoming = request_format(request.headers)
        outgoing = response_format(request.headers, preferred=incoming)
        # The call counts as in progress until the response was sent, not only until this returns.
        call = exit_stack(request).enter_context(accept(timeout(request.headers), grant))
        async with call.in_time():
            body = await self._read_body(request, self._max_bytes)
        if incoming is Format.JSON:  # always slow enough to be parsed in a thread
            encoded = EncodedRequest(body, functools.partial(read_request, kind, limits=self._limits))
        else:
            read = functools.partial(read_protobuf, kind, limits=self._limits)
            encoded = EncodedRequest(body, read, LARGE_BYTES)
        message = await cancel_on_disconnect(request.receive, execute(encoded, call))
        if outgoing is Format.PROTOBUF:  # takes less time than the handover to a thread
            return _message_response(message, outgoing)
        return await asyncio.to_thread(_message_response, message, outgoing)

    async def _execute(self, route: Route[Any, Any], request: Request, grant: Grant) -> Response:
        """Execute a unary method with small messages."""
        incoming = request_format(request.headers) if route.verb == "POST" else Format.JSON
        outgoing = response_format(request.headers, preferred=incoming)
        if route.verb == "POST":
            body = await self._read_body(request, min(_SMALL_BYTES, self._max_bytes))
            parse = parse_json if incoming is Format.JSON else parse_message
            message = parse(route.request, body)
        elif route.service == MODEL_SERVICE:  # these ignore the query
            message = route.request(**request.path_params)
        else:
            message = read_query(route.request, request.query_params)
        response = await UNARY_METHODS[route](self._dataplane, message, grant.caller.name)
        return _message_response(response, outgoing)

    async def _watch(self, route: Route[Any, Any], request: Request) -> Response:
        def events() -> AsyncIterator[Event]:
            message = read_query(route.request, request.query_params, request.path_params)
            return STREAMS[route](self._dataplane, message)

        return EventStreamResponse(self._records, self._gate, route, request, events)

    async def _read_body(self, request: Request, max_bytes: int) -> bytes:
        """Return the body; refuse one that is too large as soon as that is known.

        Raises:
            TooLarge: the body exceeds the limit, by its Content-Length or as it is received.
            Overloaded: all bodies together exceed their budget.
            RequestTimeout: the body did not arrive in time.
        """
        too_large = TooLarge(f"the body has more than {max_bytes} bytes")
        declared = request.headers.get("content-length", "")
        if declared.isdecimal() and int(declared) > max_bytes:
            raise too_large
        reserved = exit_stack(request).enter_context(self._intake.body())
        if declared.isdecimal():
            reserved.grow(int(declared))
        body = bytearray()
        try:
            async with asyncio.timeout(self._body_timeout):
                async for chunk in request.stream():
                    body += chunk
                    if len(body) > max_bytes:
                        raise too_large
                    reserved.grow(len(body))
        except TimeoutError as error:
            raise RequestTimeout(f"the body did not arrive within {self._body_timeout:g} s") from error
        return bytes(body)


class EventStreamResponse(Response):
    """A stream of messages as Server-Sent Events, ``data: <message as JSON>`` each.

    The stream ends with its messages, after the time that the request's header gives, or when the client
    disconnects. An error before the first event is a problem response, as in any call; a later one is sent
    as a last event of the type ``error``, with the problem as its data.
    """

    media_type = EVENT_STREAM

    def __init__(
        self,
        records: CallRecords,
        gate: Gate,
        route: Route[Any, Any],
        request: Request,
        events: Callable[[], AsyncIterator[Event]],
    ) -> None:
        """Create the response; the call starts when it is served.

        Args:
            records: records the call.
            gate: authenticates the caller.
            route: the contract's method.
            request: the HTTP request.
            events: opens the stream of messages; the headers are sent with the first one.
        """
        self.status_code = 200
        self.init_headers(_EVENT_HEADERS)
        self._records = records
        self._gate = gate
        self._route = route
        self._request = request
        self._events = events

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve the request to its end."""
        with self._records.record(self._route.method, timed=False) as recorder:
            writer = _BodyWriter(send, self.raw_headers)
            try:
                problem = await cancel_on_disconnect(receive, self._serve(recorder, writer))
            except ClientDisconnect:
                return
            if problem is not None:
                await problem(scope, receive, send)

    async def _serve(self, recorder: CallRecorder, writer: "_BodyWriter") -> Response | None:
        """Send all events. Return a problem response if the call fails before the first one."""
        try:
            caller = self._gate.identify(self._request.headers.get("authorization"))
            recorder.identified(caller)
            caller.require(scope_of(self._route))
            async with caller.stream():
                await self._send_events(writer)
        except Exception as exception:
            error = recorder.failed(exception)
            if not writer.started:
                return problem_response(error)
            await writer.write(b"event: error\ndata: " + orjson.dumps(to_problem(error)) + b"\n\n")
        else:
            recorder.succeeded()
        await writer.end()
        return None

    async def _send_events(self, writer: "_BodyWriter") -> None:
        headers = self._request.headers
        check_events_accepted(headers)
        # HEAD asks for the headers only.
        deadline = asyncio.timeout(0.0 if self._request.method == "HEAD" else timeout(headers))
        try:
            events = with_idle_ticks(self._events(), HEARTBEAT)
            async with deadline, aclosing(events):
                async for event in events:
                    if event is None:
                        await writer.write(b": heartbeat\n\n")
                    else:
                        await writer.write(await encoded(event, _to_event))
        except TimeoutError:
            if not deadline.expired():
                raise


class _BodyWriter:
    """Writer of a response body that is sent piece by piece."""

    def __init__(self, send: Send, headers: list[tuple[bytes, bytes]]) -> None:
        self._send = send
        self._headers = headers
        self.started = False
        """True once the headers have been sent."""

    async def write(self, body: bytes, *, more: bool = True) -> None:
        """Send a piece, and the headers before the first one."""
        if not self.started:
            self.started = True
            await self._send({"type": "http.response.start", "status": 200, "headers": self._headers})
        await self._send({"type": "http.response.body", "body": body, "more_body": more})

    async def end(self) -> None:
        """End the body."""
        await self.write(b"", more=False)


class ExitStackMiddleware:
    """Middleware that gives each request an exit stack, closed after its response was sent."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        with ExitStack() as stack:
            scope[_EXIT_STACK] = stack
            await self._app(scope, receive, send)


def exit_stack(request: Request) -> ExitStack:
    """Return the stack that is closed once the response to a request was sent."""
    stack: ExitStack = request.scope[_EXIT_STACK]
    return stack


async def cancel_on_disconnect(receive: Receive, work: Awaitable[_T]) -> _T:
    """Return the result of some work; cancel it if the client disconnects first.

    Args:
        receive: ASGI channel of a request whose body was read already.
        work: the awaitable to run.

    Raises:
        ClientDisconnect: the client disconnected.
    """
    task = asyncio.ensure_future(work)
    watch = asyncio.create_task(_wait_for_disconnect(receive))
    try:
        await asyncio.wait({task, watch}, return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise ClientDisconnect
        return task.result()
    finally:
        task.cancel()
        watch.cancel()
        await asyncio.gather(task, watch, return_exceptions=True)


async def _wait_for_disconnect(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


def _to_event(event: Event) -> bytes:
    if not isinstance(event, SharedMessage):
        text = to_json(event)
    elif event.json is not None:
        text = event.json()
    else:
        text = to_json(event.message)
    return b"data: " + text + b"\n\n"


def _message_response(message: Message, outgoing: Format) -> Response:
    body = to_json(message) if outgoing is Format.JSON else message.SerializeToString()
    return Response(body, media_type=outgoing.value)
