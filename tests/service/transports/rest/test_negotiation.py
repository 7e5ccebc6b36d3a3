"""Content negotiation by headers."""

import pytest
from starlette.datastructures import Headers

from service.errors import BadField, NotAcceptable, UnsupportedMediaType
from service.transports.rest.negotiation import (
    Format,
    check_events_accepted,
    request_format,
    response_format,
    timeout,
)

JSON, PROTOBUF = Format.JSON, Format.PROTOBUF


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (None, JSON),
        ("application/json", JSON),
        ("Application/JSON; charset=utf-8", JSON),
        ("application/x-protobuf", PROTOBUF),
    ],
)
def test_content_type(given: str | None, expected: Format) -> None:
    assert request_format(Headers({"content-type": given} if given else {})) is expected


@pytest.mark.parametrize(
    "headers",
    [
        {"content-type": "text/plain"},
        {"content-type": "application/x-www-form-urlencoded"},
        {"content-type": "application/json", "content-encoding": "gzip"},
    ],
)
def test_content_type_refused(headers: dict[str, str]) -> None:
    with pytest.raises(UnsupportedMediaType):
        request_format(Headers(headers))


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        (None, PROTOBUF),
        ("*/*", PROTOBUF),
        ("application/*", PROTOBUF),
        ("application/json", JSON),
        ("application/x-protobuf", PROTOBUF),
        ("application/x-protobuf;q=0.5, application/json", JSON),
        ("application/json;q=0.2, */*;q=0.1", JSON),
        ("text/html, */*;q=0.8", PROTOBUF),
        ("application/x-protobuf;q=0, */*", JSON),
        ("application/json;q=zero, application/x-protobuf;q=0.1", PROTOBUF),
    ],
)
def test_accept(accept: str | None, expected: Format) -> None:
    assert response_format(Headers({"accept": accept} if accept else {}), preferred=PROTOBUF) is expected


@pytest.mark.parametrize(
    "accept", ["text/html", "application/json;q=0", "*/*;q=0", ";;;", "application/json;q=nan"]
)
def test_accept_refused(accept: str) -> None:
    with pytest.raises(NotAcceptable):
        response_format(Headers({"accept": accept}), preferred=JSON)


@pytest.mark.parametrize("accept", [None, "*/*", "text/*", "text/event-stream", "text/html, */*;q=0.1"])
def test_events_accepted(accept: str | None) -> None:
    check_events_accepted(Headers({"accept": accept} if accept else {}))


@pytest.mark.parametrize("accept", ["application/json", "application/*", "text/event-stream;q=0, */*"])
def test_events_not_accepted(accept: str) -> None:
    with pytest.raises(NotAcceptable, match="text/event-stream"):
        check_events_accepted(Headers({"accept": accept}))


def test_timeout() -> None:
    assert timeout(Headers({})) is None
    assert timeout(Headers({"request-timeout": "0.25"})) == 0.25
    for wrong in ("", "soon", "-1", "0", "nan", "inf", "1,2"):
        with pytest.raises(BadField, match="Request-Timeout"):
            timeout(Headers({"request-timeout": wrong}))
