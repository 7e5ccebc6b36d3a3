"""Content negotiation: media types and timeouts from request headers."""

import math
from enum import StrEnum

from starlette.datastructures import Headers

from service.errors import BadField, NotAcceptable, UnsupportedMediaType

TIMEOUT_HEADER = "Request-Timeout"
"""Header with the seconds that the client waits for the response."""
EVENT_STREAM = "text/event-stream"
"""Media type of Server-Sent Events."""


class Format(StrEnum):
    """Media types of messages."""

    JSON = "application/json"
    PROTOBUF = "application/x-protobuf"


def request_format(headers: Headers) -> Format:
    """Return the format of the body; JSON if the headers do not name one.

    Raises:
        UnsupportedMediaType: the content type or encoding is not supported.
    """
    encoding = headers.get("content-encoding", "identity").strip().lower()
    if encoding not in ("identity", ""):
        raise UnsupportedMediaType(
            f'content-encoding "{encoding[:40]}" is not supported: send the body uncompressed'
        )
    given = headers.get("content-type", "").partition(";")[0].strip().lower()
    if not given:
        return Format.JSON
    try:
        return Format(given)
    except ValueError:
        known = " or ".join(Format)
        raise UnsupportedMediaType(f'content-type "{given[:80]}" is not supported: send {known}') from None


def response_format(headers: Headers, preferred: Format) -> Format:
    """Return the format of the response.

    Args:
        headers: headers of the request.
        preferred: the format to choose among those that the client accepts equally.

    Raises:
        NotAcceptable: the client accepts none of the formats.
    """
    ranges = _media_ranges(headers)
    order = sorted(Format, key=lambda kind: kind is not preferred)
    best = max(order, key=lambda kind: _quality(kind.value, ranges))  # the first of equals
    if _quality(best.value, ranges) <= 0:
        raise NotAcceptable(f"responses are available as {' or '.join(Format)}")
    return best


def check_events_accepted(headers: Headers) -> None:
    """Refuse a client that does not accept Server-Sent Events.

    Raises:
        NotAcceptable: the client does not accept them.
    """
    if _quality(EVENT_STREAM, _media_ranges(headers)) <= 0:
        raise NotAcceptable(f"responses are available as {EVENT_STREAM}")


def prefers_html(headers: Headers) -> bool:
    """Return whether the client wants a page rather than JSON, as browsers do."""
    ranges = _media_ranges(headers)
    return _quality("text/html", ranges) > _quality(Format.JSON.value, ranges)


def timeout(headers: Headers) -> float | None:
    """Return the seconds that the client waits for the response; None if it does not say.

    Raises:
        BadField: the header is not a positive number.
    """
    text = headers.get(TIMEOUT_HEADER)
    if text is None:
        return None
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0):
        raise BadField(TIMEOUT_HEADER, "must be a positive number of seconds")
    return seconds


def _media_ranges(headers: Headers) -> list[tuple[str, float]]:
    """Return the media ranges and qualities of the Accept header; without a header, "*/*"."""
    accept = headers.get("accept", "").strip() or "*/*"
    return [_media_range(part) for part in accept.split(",")]


def _media_range(text: str) -> tuple[str, float]:
    """Parse one media range of an Accept header. A quality that cannot be parsed counts as 0."""
    kind, *parameters = (part.strip().lower() for part in text.split(";"))
    quality = 1.0
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            try:
                quality = float(value)
            except ValueError:
                quality = 0.0
    return kind, quality if math.isfinite(quality) else 0.0


def _quality(kind: str, ranges: list[tuple[str, float]]) -> float:
    """Return the quality of a media type by the most specific range that matches (RFC 9110, 12.5.1)."""
    for pattern in (kind, f"{kind.partition('/')[0]}/*", "*/*"):
        found = [quality for given, quality in ranges if given == pattern]
        if found:
            return max(found)
    return 0.0
