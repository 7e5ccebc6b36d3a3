"""Entries of a scene's log, one per call."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgpack

from service.tracking.store.base import TrackUpdate
from service.tracking.store.records import AGENT_TYPES, AGES, FORECAST_BYTES, OBSERVATION_BYTES

_VERSION = 1
"""Version of this layout; servers skip entries of other versions."""
_AGENT_TYPES = frozenset(AGENT_TYPES.values())


class LogEntryError(ValueError):
    """Bytes that are not a valid entry."""


@dataclass(frozen=True)
class LogEntry:
    """Updates of one call."""

    time: float
    """s."""
    updates: Sequence[TrackUpdate]


def pack_log_entry(entry: LogEntry) -> bytes:
    """Return the bytes of an entry."""
    rows = [
        (
            update.agent_id,
            update.agent_type,
            update.observations,
            update.model,
            update.forecast,
            update.steps,
        )
        for update in entry.updates
    ]
    packed: bytes = msgpack.packb((_VERSION, entry.time, rows))
    return packed


def unpack_log_entry(packed: bytes) -> LogEntry:
    """Return the entry in some bytes.

    Raises:
        LogEntryError: the bytes are not an entry, or have another layout.
    """
    try:
        version, time, rows = msgpack.unpackb(packed, use_list=False)
        if version != _VERSION or not isinstance(time, float):
            raise LogEntryError("unknown layout")
        return LogEntry(time, [_update(*row) for row in rows])
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise LogEntryError(f"not an entry of a scene's log: {error}") from error


def _update(
    agent_id: Any, agent_type: Any, observations: Any, model: Any, forecast: Any, steps: Any
) -> TrackUpdate:
    valid = (
        isinstance(agent_id, str)
        and agent_type in _AGENT_TYPES
        and isinstance(observations, bytes)
        and len(observations) % OBSERVATION_BYTES == 0
        and isinstance(model, str)
        and isinstance(forecast, bytes)
        and len(forecast) in (0, FORECAST_BYTES)
        and isinstance(steps, int)
        and 0 <= steps <= AGES
    )
    if not valid:
        raise LogEntryError("unknown layout")
    return TrackUpdate(agent_id, agent_type, observations, model, forecast, steps)
