"""Messages and errors as HTTP carries them: protobuf or JSON bodies, RFC 9457 problems."""

import math
import time
from collections.abc import Mapping
from email.utils import parsedate_to_datetime
from typing import Any

import httpx
from google.protobuf import json_format
from google.protobuf.message import DecodeError

from cab_forecast.endpoints import Endpoint
from cab_forecast.errors import (
    TOO_LARGE,
    UNREACHABLE,
    DeadlineExceeded,
    FieldViolation,
    ForecastError,
    InternalError,
    Unavailable,
    error_for,
)
from cab_forecast.methods import Method, Request, Response
from cab_forecast.timing import Budget, StreamTimes
from cab_forecast.transport import Connection

EVENTS = "text/event-stream"
"""Server-Sent Events."""
_MEDIA_TYPES = {"protobuf": "application/x-protobuf", "json": "application/json"}
_PROBLEM = "application/problem+json"

# For answers that do not say their code themselves: those of gateways on the way.
_CODES = {
    400: "INVALID_ARGUMENT",
    401: "UNAUTHENTICATED",
    403: "PERMISSION_DENIED",
    404: "NOT_FOUND",
    408: "DEADLINE_EXCEEDED",
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
    """Messages to HTTP and back; all that the blocking and the asyncio transport share."""

    def __init__(self, connection: Connection) -> None:
        self._endpoint: Endpoint = connection.endpoint
        self._media_type = _MEDIA_TYPES[connection.encoding]
        self._headers = {"Authorization": f"Bearer {connection.token}"} if connection.token else {}

    def request(self, method: Method[Request, Response], request: Request, budget: Budget) -> httpx.Request:
        """The HTTP request, with what is left of the timeout told to the server and kept by httpx."""
        headers = {
            "Accept": f"{self._media_type}, {_PROBLEM}",
            # Rounding must not make nothing of a little: zero is no timeout.
            "Request-Timeout": f"{max(budget.remaining(), 1e-6):.6f}",
        }
        content = None
        if method.verb == "POST":
            headers["Content-Type"] = self._media_type
            content = self._encode(request)
        return self._request(method, request, headers, content, budget)

    def stream_request(
        self, method: Method[Request, Response], request: Request, times: StreamTimes
    ) -> httpx.Request:
        """The HTTP request for a stream, which has no deadline."""
        return self._request(method, request, {"Accept": f"{EVENTS}, {_PROBLEM}"}, None, times)

    def check_stream(self, response: httpx.Response) -> None:
        """Looks at the headers of an HTTP response that is to be a stream.

        Raises:
            ForecastError: it is an error, the body of which was read, or nothing that such a server sends.
        """
        if not response.is_success:
            raise error_from_response(response)
        if _media_type(response) != EVENTS:
            raise self._unknown_type(response, EVENTS)

    def answer(self, method: Method[Request, Response], response: httpx.Response) -> Response:
        """The message in an HTTP response.

        Raises:
            ForecastError: it is an error, or nothing that a cab-forecast server sends.
        """
        if not response.is_success:
            raise error_from_response(response)
        media_type = _media_type(response)
        message = method.response()
        try:
            if media_type == _MEDIA_TYPES["protobuf"]:
                message.ParseFromString(response.content)
            elif media_type == _MEDIA_TYPES["json"]:
                # A newer server may say more than this client knows of.
                json_format.Parse(response.content, message, ignore_unknown_fields=True)
            else:
                raise self._unknown_type(response, self._media_type)
        except (DecodeError, json_format.ParseError, UnicodeDecodeError) as error:
            raise InternalError(f"the answer of {self._endpoint.url} cannot be read: {error}") from error
        return message

    def lost(self, error: httpx.TransportError | TimeoutError, budget: Budget) -> ForecastError:
        """The exception for a call that brought no HTTP response."""
        if isinstance(error, (httpx.TimeoutException, TimeoutError)):
            return DeadlineExceeded(f"no answer from {self._endpoint.url} within {budget.timeout:g} s")
        cause = str(error) or type(error).__name__
        return Unavailable(f"no connection to {self._endpoint.url}: {cause}", reason=UNREACHABLE)

    def cut(self, error: httpx.TransportError, silence: float) -> ForecastError:
        """The exception for a stream that broke off.

        Args:
            error: what httpx says.
            silence: s without a byte after which it gave up.
        """
        if isinstance(error, httpx.TimeoutException):
            cause = f"no word from it for {silence:g} s"
        else:
            cause = str(error) or type(error).__name__
        return Unavailable(f"lost the connection to {self._endpoint.url}: {cause}", reason=UNREACHABLE)

    def _request(
        self,
        method: Method[Request, Response],
        request: Request,
        headers: dict[str, str],
        content: bytes | None,
        times: Mapping[str, float],
    ) -> httpx.Request:
        return httpx.Request(
            method.verb,
            self._endpoint.target + method.path(request),
            headers=self._headers | headers,
            content=content,
            extensions={"timeout": times},
        )

    def _unknown_type(self, response: httpx.Response, wanted: str) -> InternalError:
        return InternalError(
            f"{self._endpoint.url} answered with {_media_type(response) or 'no media type'} instead of "
            f"{wanted}; is it a cab-forecast server?"
        )

    def _encode(self, request: Request) -> bytes:
        if self._media_type == _MEDIA_TYPES["json"]:
            return json_format.MessageToJson(request, preserving_proto_field_name=True, indent=None).encode()
        return request.SerializeToString()


def error_from_response(response: httpx.Response) -> ForecastError:
    """The exception for an HTTP response that is not a success.

    Args:
        response: problem+json from the server, or anything from a gateway on the way.
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
    """The exception for a problem document.

    Args:
        problem: what the server says; may lack anything.
        code: canonical status code, where the problem does not say it.
        message: what happened, likewise.
        reason: likewise.
        retry_after: s.
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
    """s, from seconds or from an HTTP date (RFC 9110, section 10.2.3); None where it says neither."""
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
