"""Which media types come in and go out, and what else the headers of a request ask for."""

import math
from enum import StrEnum

from starlette.datastructures import Headers

from service.errors import BadField, NotAcceptable, UnsupportedMediaType

TIMEOUT_HEADER = "Request-Timeout"
"""s that the client waits for the answer."""


EVENTS = "text/event-stream"
"""Server-Sent Events."""


class Format(StrEnum):
    """How a message is written."""

    JSON = "application/json"
    PROTOBUF = "application/x-protobuf"


def request_format(headers: Headers) -> Format:
    """How the body is written; JSON when the request does not say.

    Raises:
        UnsupportedMediaType: in no way that is understood.
    """
    encoding = headers.get("content-encoding", "identity").strip().lower()
    if encoding not in ("identity", ""):
        raise UnsupportedMediaType(
            f'content-encoding "{encoding[:40]}" is not understood: send the body as it is'
        )
    given = headers.get("content-type", "").partition(";")[0].strip().lower()
    if not given:
        return Format.JSON
    try:
        return Format(given)
    except ValueError:
        known = " or ".join(Format)
        raise UnsupportedMediaType(f'content-type "{given[:80]}" is not understood: send {known}') from None


def answer_format(headers: Headers, preferred: Format) -> Format:
    """How the client wants the answer.

    Args:
        headers: of the request.
        preferred: among those that the client likes equally well.

    Raises:
        NotAcceptable: in no way that is known here.
    """
    ranges = _media_ranges(headers)
    order = sorted(Format, key=lambda kind: kind is not preferred)
    best = max(order, key=lambda kind: _quality(kind.value, ranges))  # the first of equals
    if _quality(best.value, ranges) <= 0:
        raise NotAcceptable(f"answers come as {' or '.join(Format)}")
    return best


def check_events_accepted(headers: Headers) -> None:
    """For answers that come as Server-Sent Events only.

    Raises:
        NotAcceptable: the client does not want them.
    """
    if _quality(EVENTS, _media_ranges(headers)) <= 0:
        raise NotAcceptable(f"answers come as {EVENTS}")


def timeout(headers: Headers) -> float | None:
    """s that the client gives, if it says so.

    Raises:
        BadField: it says so in no number.
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
    """Types and their qualities by an Accept header; without one anything will do."""
    accept = headers.get("accept", "").strip() or "*/*"
    return [_media_range(part) for part in accept.split(",")]


def _media_range(text: str) -> tuple[str, float]:
    """Type and quality of one part of an Accept header; what cannot be read is not wanted."""
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
    """By the most specific range that matches, as RFC 9110 has it."""
    for pattern in (kind, f"{kind.partition('/')[0]}/*", "*/*"):
        found = [quality for given, quality in ranges if given == pattern]
        if found:
            return max(found)
    return 0.0
