"""One agent's memory."""

import math
import struct
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from model.scenes.scene import STEP_SECONDS
from service.tracking.store.base import MAX_SERIES, SETTLE_AFTER, Instants, Sighting
from service.tracking.store.forecast_history import REACH, Series, Set
from service.tracking.store.observation_buffer import Sighted
from service.tracking.store.records import AGES, COMPLETE, NEWLY, SETTLED

_HEAD = struct.Struct(f"<Qddd{AGES}d")


class Instant(NamedTuple):
    """One observation's set of one series."""

    packed: bytes
    """One of ``records.INSTANT``."""
    agent_id: str
    series: str


def bundle(instants: Sequence[Instant]) -> Instants:
    """Instants put together."""
    return Instants(
        b"".join([instant.packed for instant in instants]),
        [instant.agent_id for instant in instants],
        [instant.series for instant in instants],
    )


class Track:
    """One agent.

    Args:
        kind: of ``records.KINDS``.
    """

    def __init__(self, kind: bytes) -> None:
        self._kind = kind
        self._seen = Sighted()
        self._series: dict[str, Series] = {}

    @property
    def newest(self) -> float:
        """When it was last seen or forecast, s."""
        newest = self._seen.times[-1] if len(self._seen) else -math.inf
        for series in self._series.values():
            if len(series):
                newest = max(newest, series.times[-1])
        return newest

    def fits(self, kind: bytes, given: Sighted) -> bool:
        """Whether what a call brings can be of this agent.

        Args:
            kind: of ``records.KINDS``.
            given: the observations.
        """
        return kind == self._kind and self._seen.agrees(given)

    def exchange(self, sighting: Sighting, given: Sighted, time: float, cut: float) -> list[Instant]:
        """Remembers what a call brings, which fits.

        Args:
            sighting: it.
            given: its observations.
            time: of the call, s.
            cut: s; what is older is forgotten.

        Returns:
            The newest observation of the call, if it names a series, and what else the call settled.
        """
        given.trim(cut)
        self._seen.insert(given)
        mine = self._series.get(sighting.series)
        if mine is None and sighting.forecast and len(self._series) < MAX_SERIES:
            mine = self._series[sighting.series] = Series()
        fresh = (
            mine is not None
            and bool(sighting.forecast)
            and mine.insert(time, sighting.forecast, sighting.steps)
        )
        told: list[Instant] = []
        for when in given.times:
            at = self._seen.last_until(when)
            asked = when == given.times[-1]
            for name, series in self._series.items():
                self._look(told, sighting.agent_id, name, series, at, asked and name == sighting.series)
            if asked and sighting.series and mine is None:
                self._look(told, sighting.agent_id, sighting.series, Series(), at, True)
        for name, series in self._series.items():
            for instant in tuple(series.pending):
                if self._seen.times[-1] - instant >= SETTLE_AFTER:
                    self._look(told, sighting.agent_id, name, series, self._seen.last_until(instant), False)
        if fresh and mine is not None:
            for at in self._after(time):
                self._look(told, sighting.agent_id, sighting.series, mine, at, False)
        # Last: what is due must be settled by all that was there for it
        self._seen.trim(cut)
        for series in self._series.values():
            series.trim(cut)
        return told

    def history(self, time: float, recall: float) -> bytes:
        """Observations up to a time, those of the last ``recall`` seconds, and always the last one."""
        return self._seen.history(time, recall)

    def everything(self, agent_id: str, window: float) -> Iterator[Instant]:
        """Each observation's set of every series, as it is: those of the last ``window`` seconds."""
        times = self._seen.times
        for at in range(bisect_left(times, times[-1] - window) if times else 0, len(times)):
            instant = times[at]
            for name, series in self._series.items():
                found = series.gather(instant)
                flags = COMPLETE * found.complete + SETTLED * series.is_settled(instant)
                yield self._instant(agent_id, name, at, found, flags)

    def _after(self, made: float) -> Iterator[int]:
        """The observations that a forecast says something about, newest first."""
        times = self._seen.times
        for at in range(len(times) - 1, -1, -1):
            ahead = times[at] - made
            if ahead < STEP_SECONDS - REACH:
                return
            if abs(ahead - STEP_SECONDS * math.floor(ahead / STEP_SECONDS + 0.5)) <= REACH:
                yield at

    def _look(
        self, told: list[Instant], agent_id: str, name: str, series: Series, at: int, asked: bool
    ) -> None:
        """One observation's set: settles it if it can be; tells of it then, or if it is asked for."""
        instant = self._seen.times[at]
        settled = series.is_settled(instant)
        if not asked and (settled or not series.may_be_complete(instant)):
            return
        found = series.gather(instant)
        newly = False
        if found.complete and not settled:
            newly = found.exact or self._seen.times[-1] - instant >= SETTLE_AFTER
            (series.settle if newly else series.wait)(instant)
        if asked or newly:
            flags = COMPLETE * found.complete + SETTLED * (settled or newly) + NEWLY * newly
            told.append(self._instant(agent_id, name, at, found, flags))

    def _instant(self, agent_id: str, name: str, at: int, found: Set, flags: int) -> Instant:
        head = _HEAD.pack(flags, self._seen.times[at], *self._seen.place(at), *found.made_at)
        return Instant(b"".join((head, *found.blocks)), agent_id, name)
