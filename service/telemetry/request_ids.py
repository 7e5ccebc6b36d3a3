"""Request ids: what a caller, a log line and an error can be found by."""

import re
import secrets
from collections.abc import Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field

import structlog

HEADER = "x-request-id"
"""Name of the HTTP header, and of the gRPC metadata, of requests and responses."""
TRACEPARENT = "traceparent"
"""Name of the header that holds the caller's trace (W3C Trace Context)."""
TRACESTATE = "tracestate"
"""Name of the header that goes along with it."""
_REQUEST_ID = re.compile(r"[!-~]{1,128}")
"""Ids that are taken over: printable ASCII without blanks, which is safe in headers and logs."""
_TRACEPARENT = re.compile(
    r"(?!ff)([0-9a-f]{2})-(?!0{32})([0-9a-f]{32})-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}(-.*)?"
)

_CURRENT: ContextVar["CallIds | None"] = ContextVar("call_ids", default=None)


@dataclass(frozen=True)
class CallIds:
    """Ids of one call."""

    request_id: str
    trace_id: str
    """Id of the caller's trace, 32 hexadecimal digits; empty: it has none."""
    carrier: Mapping[str, str] = field(default_factory=dict, compare=False)
    """``TRACEPARENT`` and ``TRACESTATE`` of the caller, if it has a trace."""


def ids_of(request_id: str | None, traceparent: str | None, tracestate: str | None = None) -> CallIds:
    """Return the ids of a call: its own request id, else the id of its trace, else a new one.

    Args:
        request_id: value of ``HEADER``; None: not sent. An unusable one is passed over.
        traceparent: value of ``TRACEPARENT``; None: not sent. A malformed one is passed over, as W3C demands.
        tracestate: value of ``TRACESTATE``; None: not sent.
    """
    trace_id = _trace_id(traceparent or "")
    carrier: dict[str, str] = {}
    if trace_id and traceparent:
        carrier = {TRACEPARENT: traceparent} | ({TRACESTATE: tracestate} if tracestate else {})
    if request_id is not None and _REQUEST_ID.fullmatch(request_id):
        return CallIds(request_id, trace_id, carrier)
    return CallIds(trace_id or secrets.token_hex(16), trace_id, carrier)


def begin(ids: CallIds) -> None:
    """Let all log lines of the current task, and of those that it starts, hold these ids."""
    _CURRENT.set(ids)
    traced = {"trace_id": ids.trace_id} if ids.trace_id else {}
    structlog.contextvars.clear_contextvars()
    structlog.contextvars.bind_contextvars(request_id=ids.request_id, **traced)


def current_request_id() -> str:
    """Return the id of the request that this task handles; empty outside of requests."""
    ids = _CURRENT.get()
    return "" if ids is None else ids.request_id


def current_carrier() -> Mapping[str, str]:
    """Return the trace headers of the request that this task handles; empty if there are none."""
    ids = _CURRENT.get()
    return {} if ids is None else ids.carrier


def _trace_id(traceparent: str) -> str:
    match = _TRACEPARENT.fullmatch(traceparent.strip())
    if match is None or (match[1] == "00" and match[3]):  # only later versions may have more fields
        return ""
    return match[2]
