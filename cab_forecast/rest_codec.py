"""HTTP codec of messages and errors: protobuf or JSON bodies, Server-Sent Events, RFC 9457 problems."""

import json
import math
import time
from collections.abc import Iterator, Mapping
from email.utils import parsedate_to_datetime
from typing import Any, Generic, TypeVar

import httpx
from google.protobuf import json_format
from google.protobuf.message import DecodeError, Message

from cab.forecast.v1.routes import Request, Response, Route
from cab_forecast.connection import Connection
from cab_forecast.endpoints import Endpoint
from cab_forecast.errors import (
    TOO_LARGE,
    UNREACHABLE,
    FieldViolation,
    ForecastError,
    InternalError,
    Unavailable,
    connection_failed,
    error_for,
)
from cab_forecast.timing import Budget, StreamTimeouts

EVENT_STREAM = "text/event-stream"
"""Media type of Server-Sent Events."""
_Message = TypeVar("_Message", bound=Message)

_MEDIA_TYPES = {"protobuf": "application/x-protobuf", "json": "application/json"}
_PROBLEM = "application/problem+json"

_ERROR_EVENT = "error"
"""Type of the event that ends a stream with an error."""

# Codes of responses without a problem document, which come from gateways.
_CODES = {
    400: "INVALID_ARGUMENT",
    401: "UNAUTHENTICATED",
    403: "PERMISSION_DENIED",
    404: "NOT_FOUND",
    408: "DEADLINE_EXCEEDED",
    412: "FAILED_PRECONDITION",
    413: "RESOURCE_EXHAUSTED",
    415: "INVALID_ARGUMENT",
    422: "INVALID_ARGUMENT",
    429: "RESOURCE_EXHAUSTED",
    500: "INTERNAL",
    502: "UNAVAILABLE",
    503: "UNAVAILABLE",
    504: "DEADLINE_EXCEEDED",
}


class Codec:
    """Conversion of messages to HTTP requests and of HTTP responses to messages, for both REST transports."""

    def __init__(self, connection: Connection) -> None:
        self._endpoint: Endpoint = connection.endpoint
        self._may_need_certificate = connection.may_need_certificate
        self._media_type = _MEDIA_TYPES[connection.encoding]
        self._headers = {"Authorization": f"Bearer {connection.token}"} if connection.token else {}

    def request(self, route: Route[Request, Response], request: Request, budget: Budget) -> httpx.Request:
        """Return the HTTP request of a call, with the remaining time for the server and for httpx."""
        headers = {
            "Accept": f"{self._media_type}, {_PROBLEM}",
            # Rounding must not give zero, which is no valid timeout.
            "Request-Timeout": f"{max(budget.remaining(), 1e-6):.6f}",
        }
        content = None
        if route.verb == "POST":
            headers["Content-Type"] = self._media_type
            content = self._encode(request)
        return self._request(route, request, headers, content, budget)

    def stream_request(
        self, route: Route[Request, Response], request: Request, timeouts: StreamTimeouts
    ) -> httpx.Request:
        """Return the HTTP request of a stream, which has no deadline."""
        return self._request(route, request, {"Accept": f"{EVENT_STREAM}, {_PROBLEM}"}, None, timeouts)

    def check_stream(self, response: httpx.Response) -> None:
        """Check the headers of a response that must be a stream.

        Raises:
            ForecastError: the response is an error (its body must have been read) or has another media type.
        """
        if not response.is_success:
            raise error_from_response(response)
        if _media_type(response) != EVENT_STREAM:
            raise self._unknown_type(response, EVENT_STREAM)

    def decode(self, route: Route[Request, Response], response: httpx.Response) -> Response:
        """Return the message of an HTTP response.

        Raises:
            ForecastError: the response is an error, or not from a cab-forecast server.
        """
        if not response.is_success:
            raise error_from_response(response)
        media_type = _media_type(response)
        message = route.response()
        try:
            if media_type == _MEDIA_TYPES["protobuf"]:
                message.ParseFromString(response.content)
            elif media_type == _MEDIA_TYPES["json"]:
                # A newer server may send fields that this client does not know.
                json_format.Parse(response.content, message, ignore_unknown_fields=True)
            else:
                raise self._unknown_type(response, self._media_type)
        except (DecodeError, json_format.ParseError, UnicodeDecodeError) as error:
            raise InternalError(f"the response of {self._endpoint.url} cannot be parsed: {error}") from error
        return message

    def connection_error(self, error: httpx.TransportError | TimeoutError, budget: Budget) -> ForecastError:
        """Return the exception for a call without an HTTP response."""
        if isinstance(error, (httpx.TimeoutException, TimeoutError)):
            return budget.exceeded()
        cause = str(error) or type(error).__name__
        # A server that misses a certificate ends the connection instead of a handshake or a response
        broken_off = isinstance(error, (httpx.ReadError, httpx.RemoteProtocolError))
        return connection_failed(
            self._endpoint.url, cause, may_need_certificate=broken_off and self._may_need_certificate
        )

    def stream_error(self, error: httpx.TransportError, idle_timeout: float) -> ForecastError:
        """Return the exception for a stream that was interrupted.

        Args:
            error: the error of httpx.
            idle_timeout: seconds without a byte after which it gave up.
        """
        if isinstance(error, httpx.TimeoutException):
            cause = f"no data for {idle_timeout:g} s"
        else:
            cause = str(error) or type(error).__name__
        return Unavailable(f"lost the connection to {self._endpoint.url}: {cause}", reason=UNREACHABLE)

    def _request(
        self,
        route: Route[Request, Response],
        request: Request,
        headers: dict[str, str],
        content: bytes | None,
        timeouts: Mapping[str, float],
    ) -> httpx.Request:
        return httpx.Request(
            route.verb,
            self._endpoint.target + route.target(request),
            headers=self._headers | headers,
            content=content,
            extensions={"timeout": timeouts},
        )

    def _unknown_type(self, response: httpx.Response, expected: str) -> InternalError:
        return InternalError(
            f"{self._endpoint.url} responded with {_media_type(response) or 'no media type'} instead of "
            f"{expected}; is it a cab-forecast server?"
        )

    def _encode(self, request: Request) -> bytes:
        if self._media_type == _MEDIA_TYPES["json"]:
            return json_format.MessageToJson(request, preserving_proto_field_name=True, indent=None).encode()
        return request.SerializeToString()


class EventReader(Generic[_Message]):
    """Incremental parser of Server-Sent Events."""

    def __init__(self, message_type: type[_Message]) -> None:
        self._message_type = message_type
        self._buffer = b""
        self._kind = ""
        self._data: list[str] = []

    def feed(self, chunk: bytes) -> Iterator[_Message]:
        """Yield the messages that the next chunk of the body completes.

        Empty messages are dropped: they only say that the stream has started, as the headers did.

        Raises:
            ForecastError: the server reports an error, or an event cannot be parsed.
        """
        # Split at "\n" only: an id may contain other line separators that str.splitlines knows.
        *lines, self._buffer = (self._buffer + chunk).split(b"\n")
        for line in lines:
            name, _, value = line.removesuffix(b"\r").decode(errors="replace").partition(":")
            if name == "data":
                self._data.append(value.removeprefix(" "))
            elif name == "event":
                self._kind = value.strip()
            elif not line.strip():
                message = self._message()
                if message.ByteSize():
                    yield message

    def _message(self) -> _Message:
        data, kind = "\n".join(self._data), self._kind
        self._data, self._kind = [], ""
        try:
            if not data:
                return self._message_type()
            if kind == _ERROR_EVENT:
                problem = json.loads(data)
                raise error_from_problem(
                    problem if isinstance(problem, dict) else {}, message="the stream failed"
                )
            # A newer server may send fields that this client does not know.
            return json_format.Parse(data, self._message_type(), ignore_unknown_fields=True)
        except (json_format.ParseError, ValueError) as error:
            raise InternalError(f"an event cannot be parsed: {error}") from error


def error_from_response(response: httpx.Response) -> ForecastError:
    """Return the exception for an HTTP response that is not a success.

    Args:
        response: problem+json from the server, or anything from a gateway.
    """
    return error_from_problem(
        _problem(response),
        code=_CODES.get(response.status_code, "UNKNOWN"),
        message=f"HTTP {response.status_code} {response.reason_phrase}".rstrip(),
        reason=TOO_LARGE if response.status_code == httpx.codes.REQUEST_ENTITY_TOO_LARGE else "",
        retry_after=_retry_after(response.headers.get("Retry-After")),
    )


def error_from_problem(
    problem: Mapping[str, Any],
    *,
    code: str = "UNKNOWN",
    message: str = "",
    reason: str = "",
    retry_after: float | None = None,
) -> ForecastError:
    """Return the exception for a problem document.

    Args:
        problem: the problem document; any part may be missing.
        code: canonical status code if the problem has none.
        message: message if the problem has none.
        reason: reason if the problem has none.
        retry_after: seconds; None: the server did not say.
    """
    errors = problem.get("errors")
    return error_for(
        str(problem.get("code") or code),
        str(problem.get("detail") or problem.get("title") or message),
        reason=str(problem.get("reason") or reason),
        field_violations=[
            FieldViolation(str(entry.get("field", "")), str(entry.get("detail", "")))
            for entry in (errors if isinstance(errors, list) else [])
            if isinstance(entry, dict)
        ],
        retry_after=retry_after,
        request_id=str(problem.get("request_id") or ""),
    )


def _problem(response: httpx.Response) -> dict[str, Any]:
    if _media_type(response) not in (_PROBLEM, _MEDIA_TYPES["json"]):
        return {}
    try:
        body = response.json()
    except ValueError:
        return {}
    return body if isinstance(body, dict) else {}


def _media_type(response: httpx.Response) -> str:
    content_type: str = response.headers.get("Content-Type", "")
    return content_type.partition(";")[0].strip().lower()


def _retry_after(value: str | None) -> float | None:
    """Return the seconds of a Retry-After header, which holds seconds or an HTTP date (RFC 9110, 10.2.3)."""
    if value is None:
        return None
    try:
        seconds = float(value)
    except ValueError:
        try:
            seconds = parsedate_to_datetime(value).timestamp() - time.time()
        except ValueError:
            return None
    return max(seconds, 0.0) if math.isfinite(seconds) else None
