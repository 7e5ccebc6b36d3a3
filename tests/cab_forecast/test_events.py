"""Parsing of Server-Sent Events."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cab.forecast.v1.consistency_service_pb2 import InstantConsistency, WatchSceneResponse
from cab_forecast import BadRequest, ForecastError, InternalError
from cab_forecast.rest_codec import EventReader

BODY = (
    ': heartbeat\n\nevent: error\n\ndata: {"missed": "1"}\n\n'
    'retry: 5\r\ndata:{"instants":[{"agent_id": "a\u2028\x85ä"}]}\r\n\r\n'
    'id: 4\ndata: {\ndata: "missed": "3", "news": 7}\n\n\n\nevent: other\n\ndata: {"missed": "9"}'
).encode()
MESSAGES = [
    WatchSceneResponse(missed=1),
    WatchSceneResponse(instants=[InstantConsistency(agent_id="a\u2028\x85ä")]),
    WatchSceneResponse(missed=3),
]


@given(cuts=st.lists(st.integers(0, len(BODY)), max_size=20))
def test_messages_come_in_any_pieces(cuts: list[int]) -> None:
    reader = EventReader(WatchSceneResponse)
    found: list[WatchSceneResponse] = []
    for start, end in zip([0, *sorted(cuts)], [*sorted(cuts), len(BODY)], strict=True):
        found += reader.feed(BODY[start:end])
    assert found == MESSAGES  # the last one was not complete


@pytest.mark.parametrize("data", ["{", "7", "soon", '{"missed": "many"}'])
def test_what_cannot_be_read(data: str) -> None:
    with pytest.raises(InternalError, match="cannot be parsed"):
        list(EventReader(WatchSceneResponse).feed(f"data: {data}\n\n".encode()))


def test_errors() -> None:
    problem = '{"code": "INVALID_ARGUMENT", "detail": "no", "errors": [{"field": "f", "detail": "d"}]}'
    with pytest.raises(BadRequest, match="no; f: d"):
        list(EventReader(WatchSceneResponse).feed(f"event: error\ndata: {problem}\n\n".encode()))
    with pytest.raises(ForecastError, match="the stream failed"):
        list(EventReader(WatchSceneResponse).feed(b"event: error\ndata: []\n\n"))
