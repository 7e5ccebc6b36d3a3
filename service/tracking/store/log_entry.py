"""One call as an entry of a scene's log."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgpack

from service.tracking.store.base import Sighting
from service.tracking.store.records import AGES, FORECAST_BYTES, KINDS, OBSERVATION_BYTES

_VERSION = 1
"""Of this layout. Servers leave out what is of another one."""
_KINDS = frozenset(KINDS.values())


class EntryError(ValueError):
    """Bytes that are no entry."""


@dataclass(frozen=True)
class Entry:
    """What one call brought."""

    time: float
    """s."""
    sightings: Sequence[Sighting]


def pack_entry(entry: Entry) -> bytes:
    """An entry in bytes."""
    rows = [
        (one.agent_id, one.kind, one.observations, one.series, one.forecast, one.steps)
        for one in entry.sightings
    ]
    packed: bytes = msgpack.packb((_VERSION, entry.time, rows))
    return packed


def unpack_entry(packed: bytes) -> Entry:
    """An entry from its bytes.

    Raises:
        EntryError: it is none, or of another layout.
    """
    try:
        version, time, rows = msgpack.unpackb(packed, use_list=False)
        if version != _VERSION or not isinstance(time, float):
            raise EntryError("of another layout")
        return Entry(time, [_sighting(*row) for row in rows])
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise EntryError(f"no entry of a scene's log: {error}") from error


def _sighting(
    agent_id: Any, kind: Any, observations: Any, series: Any, forecast: Any, steps: Any
) -> Sighting:
    fits = (
        isinstance(agent_id, str)
        and kind in _KINDS
        and isinstance(observations, bytes)
        and len(observations) % OBSERVATION_BYTES == 0
        and isinstance(series, str)
        and isinstance(forecast, bytes)
        and len(forecast) in (0, FORECAST_BYTES)
        and isinstance(steps, int)
        and 0 <= steps <= AGES
    )
    if not fits:
        raise EntryError("of another layout")
    return Sighting(agent_id, kind, observations, series, forecast, steps)
