"""Packing and unpacking of log entries."""

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.tracking.store.base import TrackUpdate
from service.tracking.store.log_entry import LogEntry, LogEntryError, pack_log_entry, unpack_log_entry
from service.tracking.store.records import FORECAST_BYTES, OBSERVATION_BYTES

UPDATES = st.builds(
    TrackUpdate,
    st.text(min_size=1),
    st.sampled_from([b"v", b"p", b"c", b"u"]),
    st.binary(min_size=OBSERVATION_BYTES, max_size=OBSERVATION_BYTES).map(lambda one: one * 2),
    st.text(),
    st.one_of(st.just(b""), st.binary(min_size=FORECAST_BYTES, max_size=FORECAST_BYTES)),
    st.integers(0, 12),
)


@given(st.floats(allow_nan=False), st.lists(UPDATES, max_size=4))
def test_what_is_packed_comes_back(time: float, updates: list[TrackUpdate]) -> None:
    entry = LogEntry(time, updates)
    assert unpack_log_entry(pack_log_entry(entry)) == entry


@given(st.binary())
def test_other_bytes_are_refused(packed: bytes) -> None:
    with pytest.raises(LogEntryError):
        unpack_log_entry(packed)


@given(st.data())
def test_half_an_entry_is_refused(data: st.DataObject) -> None:
    packed = pack_log_entry(LogEntry(1.0, [data.draw(UPDATES)]))
    with pytest.raises(LogEntryError):
        unpack_log_entry(packed[: data.draw(st.integers(0, len(packed) - 1))])


@pytest.mark.parametrize(
    "document",
    [
        (2, 1.0, []),
        (1, "1.0", []),
        (1, 1.0, None),
        (1, 1.0, [("a", b"v", b"", "m", b"")]),
        (1, 1.0, [("a", b"x", b"", "m", b"", 0)]),
        (1, 1.0, [("a", b"v", b"1", "m", b"", 0)]),
        (1, 1.0, [("a", b"v", b"", "m", b"1", 0)]),
        (1, 1.0, [("a", b"v", b"", "m", b"", 13)]),
        (1, 1.0, [(1, b"v", b"", "m", b"", 0)]),
    ],
)
def test_another_layout_is_refused(document: object) -> None:
    with pytest.raises(LogEntryError):
        unpack_log_entry(msgpack.packb(document))
