"""Choice of request ids."""

import re
from contextvars import copy_context

import pytest
import structlog

from service.telemetry.request_ids import CallIds, begin, current_request_id, ids_of

TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"
PARENT = f"00-{TRACE}-00f067aa0ba902b7-01"


def test_the_callers_own_id_comes_first() -> None:
    assert ids_of("tick-17", None) == CallIds("tick-17", "")
    assert ids_of("tick-17", PARENT) == CallIds("tick-17", TRACE)
    assert ids_of(None, PARENT) == CallIds(TRACE, TRACE)


@pytest.mark.parametrize("unusable", [None, "", "a b", "tick\n17", "ä", "x" * 129])
def test_an_unusable_id_is_replaced(unusable: str | None) -> None:
    first, second = ids_of(unusable, None), ids_of(unusable, None)
    assert re.fullmatch("[0-9a-f]{32}", first.request_id)
    assert first.request_id != second.request_id
    assert first.trace_id == ""


@pytest.mark.parametrize(
    ("traceparent", "trace_id"),
    [
        (PARENT, TRACE),
        (f"01-{TRACE}-00f067aa0ba902b7-01-more", TRACE),
        (f"00-{TRACE}-00f067aa0ba902b7-01-more", ""),
        (f"ff-{TRACE}-00f067aa0ba902b7-01", ""),
        (f"00-{'0' * 32}-00f067aa0ba902b7-01", ""),
        (f"00-{TRACE}-{'0' * 16}-01", ""),
        (f"00-{TRACE.upper()}-00f067aa0ba902b7-01", ""),
        ("nonsense", ""),
    ],
)
def test_only_valid_traces_are_taken_over(traceparent: str, trace_id: str) -> None:
    assert ids_of("own", traceparent).trace_id == trace_id


def test_log_lines_hold_the_ids_of_the_last_request() -> None:
    def check() -> None:
        begin(ids_of("first", PARENT))
        begin(ids_of("second", None))
        assert current_request_id() == "second"
        assert structlog.contextvars.get_contextvars() == {"request_id": "second"}

    copy_context().run(check)
