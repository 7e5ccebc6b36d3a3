"""One agent's memory."""

import math
import struct
from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from model.observations import JUMP_SLACK, MAX_SPEED
from model.resample import TIME_TOLERANCE
from model.scene import STEP_SECONDS
from service.history.records import AGES, BLOCK, COMPLETE, NEWLY, OBSERVATION_BYTES, SETTLED
from service.history.store import (
    AGE_TOLERANCE,
    MAX_FORECASTS,
    MAX_SERIES,
    SETTLE_AFTER,
    Instants,
    Sighting,
)

_BLOCK_BYTES = BLOCK.itemsize
_ABSENT = b"\xff" * (3 * _BLOCK_BYTES)
"""NaN in every number."""
_REACH = AGE_TOLERANCE + TIME_TOLERANCE
_HEAD = struct.Struct("<Qddd")
_TIMES = struct.Struct(f"<{AGES}d")
_PLACE = struct.Struct("<ddd")


class Instant(NamedTuple):
    """One observation's set of one series."""

    packed: bytes
    """One of ``records.INSTANT``."""
    agent_id: str
    series: str


def bundle(instants: Sequence[Instant]) -> Instants:
    """Instants put together."""
    return Instants(
        b"".join(instant.packed for instant in instants),
        [instant.agent_id for instant in instants],
        [instant.series for instant in instants],
    )


class _Observation(NamedTuple):
    time: float
    x: float
    y: float
    record: bytes

    @classmethod
    def parse(cls, packed: bytes) -> "list[_Observation]":
        observations = []
        for at in range(0, len(packed), OBSERVATION_BYTES):
            time, x, y = _PLACE.unpack_from(packed, at)
            observations.append(cls(time, x, y, packed[at : at + OBSERVATION_BYTES]))
        return observations

    def reaches(self, other: "_Observation") -> bool:
        dx, dy = other.x - self.x, other.y - self.y
        distance = math.sqrt(dx * dx + dy * dy)
        return distance <= MAX_SPEED * abs(other.time - self.time) + JUMP_SLACK


@dataclass
class Series:
    """What one model said."""

    times: list[float] = field(default_factory=list)
    """s, ascending, when forecasts were made."""
    forecasts: dict[float, tuple[bytes, int]] = field(default_factory=dict)
    """Bytes and steps."""
    settled: set[float] = field(default_factory=set)
    pending: list[float] = field(default_factory=list)
    """Instants whose set is complete but not settled yet."""

    def insert(self, made: float, forecast: bytes, steps: int) -> bool:
        """Keeps a forecast, unless there is one of that time already; whether it did."""
        at = bisect_right(self.times, made + TIME_TOLERANCE)
        if at > 0 and made - self.times[at - 1] <= TIME_TOLERANCE:
            return False
        self.times.insert(at, made)
        self.forecasts[made] = forecast, steps
        return True

    def trim(self, cut: float) -> None:
        drop = max(bisect_left(self.times, cut), len(self.times) - MAX_FORECASTS)
        if drop <= 0:
            return
        for made in self.times[:drop]:
            del self.forecasts[made]
        del self.times[:drop]
        self.settled = {instant for instant in self.settled if instant >= cut}
        self.pending = [instant for instant in self.pending if instant >= cut]

    def nearest(self, instant: float) -> tuple[dict[int, float], bool]:
        """When the forecast nearest to each lag of an instant was made, by age, and whether all are on it."""
        times, found, exact = self.times, {}, True
        for age in range(1, AGES + 1):
            lag = instant - age * STEP_SECONDS
            after = bisect_right(times, lag)
            best, off = None, _REACH
            if after > 0 and lag - times[after - 1] <= off:
                best, off = times[after - 1], lag - times[after - 1]
            if after < len(times):
                late = times[after] - lag
                if late < off or (best is None and late <= off):
                    best, off = times[after], late
            if best is not None:
                found[age] = best
                exact = exact and off <= TIME_TOLERANCE
        return found, exact

    def slots(self, found: dict[int, float]) -> tuple[bytes, bool]:
        """When forecasts for an instant were made, what they say, by age, and whether each age is there."""
        made, parts = [math.nan] * AGES, [_ABSENT] * AGES
        complete = True
        for age in range(1, AGES + 1):
            forecast, steps = self.forecasts[found[age]] if age in found else (b"", 0)
            if steps < age:
                complete = False
                continue
            made[age - 1] = found[age]
            parts[age - 1] = forecast[(age - 1) * _BLOCK_BYTES : (age + 2) * _BLOCK_BYTES]
        return _TIMES.pack(*made) + b"".join(parts), complete


class Track:
    """One agent.

    Args:
        kind: of ``records.KINDS``.
    """

    def __init__(self, kind: bytes) -> None:
        self.kind = kind
        self._observations: list[_Observation] = []
        self._series: dict[str, Series] = {}

    @property
    def newest(self) -> float:
        """When it was last seen or forecast, s."""
        seen = [self._observations[-1].time] if self._observations else []
        return max([*seen, *(series.times[-1] for series in self._series.values() if series.times)])

    def fits(self, sighting: Sighting) -> bool:
        """Whether what a call brings can be of this agent: nowhere is it farther off than anything moves."""
        return sighting.kind == self.kind and all(
            near.reaches(one)
            for one in _Observation.parse(sighting.observations)
            for near in self._around(one.time)
        )

    def exchange(self, sighting: Sighting, time: float, cut: float) -> Iterator[Instant]:
        """Remembers what a call brings, which fits; tells of its newest observation and what it settles.

        Args:
            sighting: it.
            time: of the call, s.
            cut: s; what is older is forgotten.
        """
        agent_id = sighting.agent_id
        given = [one for one in _Observation.parse(sighting.observations) if one.time >= cut]
        for one in given:
            before = self._last_until(one.time)
            if before < 0 or one.time - self._observations[before].time > TIME_TOLERANCE:
                self._observations.insert(before + 1, one)
        mine = self._series.get(sighting.series)
        if mine is None and sighting.forecast and len(self._series) < MAX_SERIES:
            mine = self._series[sighting.series] = Series()
        fresh = (
            mine is not None
            and bool(sighting.forecast)
            and mine.insert(time, sighting.forecast, sighting.steps)
        )

        newest = self._observations[-1].time if self._observations else time
        self._trim(cut)
        for one in given:
            at = self._last_until(one.time)
            last = one is given[-1]
            for name, series in self._series.items():
                yield from self._look(agent_id, name, series, at, asked=last and name == sighting.series)
            if last and sighting.series and mine is None:
                yield from self._look(agent_id, sighting.series, Series(), at, asked=True)
        for name, series in self._series.items():
            for instant in list(series.pending):
                if newest - instant >= SETTLE_AFTER:
                    yield from self._look(agent_id, name, series, self._last_until(instant))
        if fresh and mine is not None:
            for at in self._after(time):
                yield from self._look(agent_id, sighting.series, mine, at)

    def history(self, time: float, recall: float) -> bytes:
        """Observations up to a time, those of the last ``recall`` seconds, and always the last one."""
        last = self._last_until(time)
        first = last
        while first > 0 and self._observations[first - 1].time >= time - recall:
            first -= 1
        return b"".join(one.record for one in self._observations[first : last + 1]) if last >= 0 else b""

    def everything(self, agent_id: str) -> Iterator[Instant]:
        """Every observation's set of every series, as it is."""
        for at in range(len(self._observations)):
            for name, series in self._series.items():
                instant = self._observations[at].time
                slots, complete = series.slots(series.nearest(instant)[0])
                flags = COMPLETE * complete + SETTLED * (instant in series.settled)
                yield self._instant(agent_id, name, at, slots, flags)

    def _last_until(self, when: float) -> int:
        """The last observation that is not after a time; −1: none. Calls mostly bring the newest."""
        at = len(self._observations) - 1
        while at >= 0 and self._observations[at].time > when + TIME_TOLERANCE:
            at -= 1
        return at

    def _around(self, when: float) -> list[_Observation]:
        before = self._last_until(when)
        return self._observations[max(before, 0) : before + 2]

    def _after(self, made: float) -> Iterator[int]:
        """The observations that a forecast says something about, newest first."""
        for at in range(len(self._observations) - 1, -1, -1):
            ahead = self._observations[at].time - made
            if ahead < STEP_SECONDS - _REACH:
                return
            if abs(ahead - STEP_SECONDS * math.floor(ahead / STEP_SECONDS + 0.5)) <= _REACH:
                yield at

    def _trim(self, cut: float) -> None:
        keep = 0
        while keep < len(self._observations) and self._observations[keep].time < cut:
            keep += 1
        del self._observations[:keep]
        for series in self._series.values():
            series.trim(cut)

    def _look(
        self, agent_id: str, name: str, series: Series, at: int, asked: bool = False
    ) -> Iterator[Instant]:
        """One observation's set: settles it if it can be; tells of it then, or if it is asked for."""
        instant = self._observations[at].time
        settled = instant in series.settled
        if settled and not asked:
            return
        found, exact = series.nearest(instant)
        if len(found) < AGES and not asked:
            return
        slots, complete = series.slots(found)
        newly = False
        if complete and not settled:
            if exact or self._observations[-1].time - instant >= SETTLE_AFTER:
                newly = True
                series.settled.add(instant)
                if instant in series.pending:
                    series.pending.remove(instant)
            elif instant not in series.pending:
                insort(series.pending, instant)
        if asked or newly:
            flags = COMPLETE * complete + SETTLED * (settled or newly) + NEWLY * newly
            yield self._instant(agent_id, name, at, slots, flags)

    def _instant(self, agent_id: str, name: str, at: int, slots: bytes, flags: int) -> Instant:
        one = self._observations[at]
        return Instant(_HEAD.pack(flags, one.time, one.x, one.y) + slots, agent_id, name)
