"""Observations of one agent."""

import struct

from model.scenes.observations import JUMP_SLACK, MAX_SPEED
from model.scenes.resample import TIME_TOLERANCE
from service.tracking.store.records import OBSERVATION_BYTES

MAX_DISAGREEMENT = 0.1
"""Metres between two observations of the same time, at most; beyond it they contradict each other."""

_POSITION = struct.Struct("<ddd")
"""Time, x and y of an observation."""


class ObservationBuffer:
    """Observations, ascending by time, at most one per ``TIME_TOLERANCE``."""

    def __init__(self) -> None:
        # Numbers and bytes in lists: one object per observation would keep the garbage collector busy
        self.times: list[float] = []
        """s."""
        self._positions: list[complex] = []
        """m, x + iy."""
        self._records: list[bytes] = []

    def __len__(self) -> int:
        return len(self.times)

    @classmethod
    def parse(cls, packed: bytes) -> "ObservationBuffer":
        """Return the observations of a call, which ascend by time."""
        buffer = cls()
        if len(packed) == OBSERVATION_BYTES:  # nearly always
            time, x, y = _POSITION.unpack_from(packed)
            buffer.times, buffer._positions, buffer._records = [time], [complex(x, y)], [packed]
            return buffer
        for at in range(0, len(packed), OBSERVATION_BYTES):
            time, x, y = _POSITION.unpack_from(packed, at)
            buffer.times.append(time)
            buffer._positions.append(complex(x, y))
            buffer._records.append(packed[at : at + OBSERVATION_BYTES])
        return buffer

    def position(self, at: int) -> tuple[float, float]:
        """Return x and y of an observation, m."""
        position = self._positions[at]
        return position.real, position.imag

    def last_until(self, when: float) -> int:
        """Return the index of the last observation not after a time; −1: there is none."""
        times = self.times
        at = len(times) - 1  # a linear search: calls mostly bring the newest observation
        while at >= 0 and times[at] > when + TIME_TOLERANCE:
            at -= 1
        return at

    def agrees(self, other: "ObservationBuffer") -> bool:
        """Return whether other observations can be of the same agent: no implied speed is impossible."""
        for time, position in zip(other.times, other._positions, strict=True):
            before = self.last_until(time)
            for at in (before, before + 1):
                if not 0 <= at < len(self.times):
                    continue
                apart = abs(time - self.times[at])
                # Observations of the same time must agree: a repeated call sends the same ones
                slack = JUMP_SLACK if apart > TIME_TOLERANCE else MAX_DISAGREEMENT
                if abs(position - self._positions[at]) > MAX_SPEED * apart + slack:
                    return False
        return True

    def insert(self, other: "ObservationBuffer") -> None:
        """Add other observations; existing ones of the same times are kept."""
        for number, time in enumerate(other.times):
            at = self.last_until(time)
            if at >= 0 and time - self.times[at] <= TIME_TOLERANCE:
                continue
            self.times.insert(at + 1, time)
            self._positions.insert(at + 1, other._positions[number])
            self._records.insert(at + 1, other._records[number])

    def trim(self, cut: float) -> None:
        """Drop observations older than a time."""
        drop = 0
        while drop < len(self.times) and self.times[drop] < cut:
            drop += 1
        if drop:
            del self.times[:drop], self._positions[:drop], self._records[:drop]

    def history(self, time: float, history_s: float) -> bytes:
        """Return the observations of the last ``history_s`` seconds before a time, at least the last one."""
        last = self.last_until(time)
        first = last
        while first > 0 and self.times[first - 1] >= time - history_s:
            first -= 1
        return b"".join(self._records[first : last + 1]) if last >= 0 else b""
