"""Calls over REST: protobuf or JSON bodies, errors as RFC 9457 problems."""

import asyncio
import math
import ssl
import time
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
from cab_forecast.timing import Budget
from cab_forecast.transport import Connection

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


class RestTransport:
    """Blocking calls over a pool of connections; usable from several threads."""

    def __init__(self, connection: Connection) -> None:
        self._codec = _Codec(connection)
        self._client = httpx.Client(verify=_verify(connection))

    def call(self, method: Method[Request, Response], request: Request, budget: Budget) -> Response:
        """As ``Transport.call``."""
        sent = self._codec.request(method, request, budget)
        try:
            response = self._client.send(sent, stream=True)
            try:
                complete = _read(response, budget)
            finally:
                response.close()
        except httpx.TransportError as error:
            raise self._codec.lost(error, budget) from error
        return self._codec.answer(method, complete)

    def close(self) -> None:
        """As ``Transport.close``."""
        self._client.close()


class AsyncRestTransport:
    """Calls over a pool of connections, for asyncio."""

    def __init__(self, connection: Connection) -> None:
        self._codec = _Codec(connection)
        self._client = httpx.AsyncClient(verify=_verify(connection))

    async def call(self, method: Method[Request, Response], request: Request, budget: Budget) -> Response:
        """As ``AsyncTransport.call``."""
        sent = self._codec.request(method, request, budget)
        try:
            # httpx bounds each read by itself: a body that trickles would never be late
            async with asyncio.timeout(budget.remaining()):
                response = await self._client.send(sent)
        except (httpx.TransportError, TimeoutError) as error:
            raise self._codec.lost(error, budget) from error
        return self._codec.answer(method, response)

    async def close(self) -> None:
        """As ``AsyncTransport.close``."""
        await self._client.aclose()


class _Codec:
    """Messages to HTTP and back; all that the blocking and the asyncio transport share."""

    def __init__(self, connection: Connection) -> None:
        self._endpoint: Endpoint = connection.endpoint
        self._media_type = _MEDIA_TYPES[connection.encoding]
        self._headers = {"Accept": f"{self._media_type}, {_PROBLEM}"}
        if connection.token:
            self._headers["Authorization"] = f"Bearer {connection.token}"

    def request(self, method: Method[Request, Response], request: Request, budget: Budget) -> httpx.Request:
        """The HTTP request, with what is left of the timeout told to the server and kept by httpx."""
        # Rounding must not make nothing of a little: zero is no timeout.
        headers = self._headers | {"Request-Timeout": f"{max(budget.remaining(), 1e-6):.6f}"}
        content = None
        if method.verb == "POST":
            headers["Content-Type"] = self._media_type
            content = self._encode(request)
        return httpx.Request(
            method.verb,
            self._endpoint.target + method.path(request),
            headers=headers,
            content=content,
            extensions={"timeout": budget},
        )

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
                raise InternalError(
                    f"{self._endpoint.url} answered with {media_type or 'no media type'} instead of "
                    f"{self._media_type}; is it a cab-forecast server?"
                )
        except (DecodeError, json_format.ParseError, UnicodeDecodeError) as error:
            raise InternalError(f"the answer of {self._endpoint.url} cannot be read: {error}") from error
        return message

    def lost(self, error: httpx.TransportError | TimeoutError, budget: Budget) -> ForecastError:
        """The exception for a call that brought no HTTP response."""
        if isinstance(error, (httpx.TimeoutException, TimeoutError)):
            return DeadlineExceeded(f"no answer from {self._endpoint.url} within {budget.timeout:g} s")
        cause = str(error) or type(error).__name__
        return Unavailable(f"no connection to {self._endpoint.url}: {cause}", reason=UNREACHABLE)

    def _encode(self, request: Request) -> bytes:
        if self._media_type == _MEDIA_TYPES["json"]:
            return json_format.MessageToJson(request, preserving_proto_field_name=True, indent=None).encode()
        return request.SerializeToString()


def _read(response: httpx.Response, budget: Budget) -> httpx.Response:
    """A streamed response with its body.

    httpx bounds each read of a body by what was left when the body began, so that one which trickles would
    never be late. Here the clock is looked at after each read: the last one may overrun, no more.

    Raises:
        DeadlineExceeded: the body took too long.
    """
    body = bytearray()
    for chunk in response.iter_raw():
        budget.remaining()
        body += chunk
    return httpx.Response(
        response.status_code, headers=response.headers, content=bytes(body), extensions=response.extensions
    )


def error_from_response(response: httpx.Response) -> ForecastError:
    """The exception for an HTTP response that is not a success.

    Args:
        response: problem+json from the server, or anything from a gateway on the way.
    """
    problem = _problem(response)
    code = str(problem.get("code") or _CODES.get(response.status_code, "UNKNOWN"))
    reason = str(
        problem.get("reason")
        or (TOO_LARGE if response.status_code == httpx.codes.REQUEST_ENTITY_TOO_LARGE else "")
    )
    message = str(
        problem.get("detail")
        or problem.get("title")
        or f"HTTP {response.status_code} {response.reason_phrase}".rstrip()
    )
    errors = problem.get("errors")
    return error_for(
        code,
        message,
        reason=reason,
        field_violations=[
            FieldViolation(str(entry.get("field", "")), str(entry.get("detail", "")))
            for entry in (errors if isinstance(errors, list) else [])
            if isinstance(entry, dict)
        ],
        retry_after=_retry_after(response.headers.get("Retry-After")),
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


def _verify(connection: Connection) -> ssl.SSLContext | bool:
    return ssl.create_default_context(cafile=connection.ca_file) if connection.ca_file else True
