"""Answers that go on: messages as Server-Sent Events."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import aclosing

import orjson
from google.protobuf.message import Message
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from service.transports.rest.calls import Calls, Counted, unless_disconnected
from service.transports.rest.codec import to_json
from service.transports.rest.negotiation import EVENTS, check_events_accepted, timeout
from service.transports.rest.problem import problem_response, to_problem
from service.transports.watching import paced

HEARTBEAT = 15.0
"""s without an event after which a comment tells the client, and what is between, that this goes on."""
_HEADERS = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}  # nothing between may keep events back


class EventStream(Response):
    """The messages of a call, ``data: <message as JSON>`` each. Ends with them, at the time that the request
    gives, or when the client goes away, and lets go of them then.

    An error before the first message is a problem as of any call; one that comes later is told as an event
    of the type ``error``, with the problem in its data, and is the last.
    """

    media_type = EVENTS

    def __init__(
        self,
        calls: Calls,
        method: str,
        request: Request,
        messages: Callable[[Request], AsyncIterator[Message]],
    ) -> None:
        """
        Args:
            calls: what counts this one.
            method: of the contract.
            request: as it came.
            messages: gives them; the headers go with the first.
        """
        self.status_code = 200
        self.init_headers(_HEADERS)
        self._calls = calls
        self._method = method
        self._request = request
        self._messages = messages

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serves the request to its end."""
        with self._calls.counted(self._method, timed=False) as call:
            sending = _Sending(send, self.raw_headers)
            try:
                refusal = await unless_disconnected(receive, self._serve(call, sending))
            except ClientDisconnect:
                call.left()
                return
            if refusal is not None:
                await refusal(scope, receive, send)

    async def _serve(self, call: Counted, sending: "_Sending") -> Response | None:
        """Sends everything; gives the problem back where nothing could be sent."""
        try:
            await self._send_messages(sending)
        except Exception as exception:
            error = call.failed(exception)
            if not sending.started:
                return problem_response(error)
            await sending.text(b"event: error\ndata: " + orjson.dumps(to_problem(error)) + b"\n\n")
        else:
            call.ended()
        await sending.end()
        return None

    async def _send_messages(self, sending: "_Sending") -> None:
        self._calls.authorize(self._request)
        check_events_accepted(self._request.headers)
        # Of a HEAD only the headers are wanted
        seconds = 0.0 if self._request.method == "HEAD" else timeout(self._request.headers)
        over = asyncio.timeout(seconds)
        try:
            messages = paced(self._messages(self._request), HEARTBEAT)
            async with over, aclosing(messages):
                async for message in messages:
                    if message is None:
                        await sending.text(b": heartbeat\n\n")
                    else:
                        await sending.text(b"data: " + to_json(message) + b"\n\n")
        except TimeoutError:
            if not over.expired():
                raise


class _Sending:
    """A body that is sent as it comes."""

    def __init__(self, send: Send, headers: list[tuple[bytes, bytes]]) -> None:
        self._send = send
        self._headers = headers
        self.started = False
        """Whether headers are out."""

    async def text(self, body: bytes, *, more: bool = True) -> None:
        """Sends a piece; the headers go before the first."""
        if not self.started:
            self.started = True
            await self._send({"type": "http.response.start", "status": 200, "headers": self._headers})
        await self._send({"type": "http.response.body", "body": body, "more_body": more})

    async def end(self) -> None:
        """Sends the end."""
        await self.text(b"", more=False)
