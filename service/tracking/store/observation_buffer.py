"""Where one agent was seen."""

import struct

from model.scenes.observations import JUMP_SLACK, MAX_SPEED
from model.scenes.resample import TIME_TOLERANCE
from service.tracking.store.records import OBSERVATION_BYTES

SAME_PLACE = 0.1
"""m; two observations of one time that are farther apart contradict each other."""

_PLACE = struct.Struct("<ddd")


class Sighted:
    """Observations by ascending time, none within ``TIME_TOLERANCE`` of another."""

    def __init__(self) -> None:
        # Numbers and bytes in lists: an object each would keep the garbage collector busy
        self.times: list[float] = []
        """s."""
        self._places: list[complex] = []
        """m, x + iy."""
        self._records: list[bytes] = []

    def __len__(self) -> int:
        return len(self.times)

    @classmethod
    def parse(cls, packed: bytes) -> "Sighted":
        """Those of a call; by ascending time."""
        made = cls()
        if len(packed) == OBSERVATION_BYTES:  # nearly always
            time, x, y = _PLACE.unpack_from(packed)
            made.times, made._places, made._records = [time], [complex(x, y)], [packed]
            return made
        for at in range(0, len(packed), OBSERVATION_BYTES):
            time, x, y = _PLACE.unpack_from(packed, at)
            made.times.append(time)
            made._places.append(complex(x, y))
            made._records.append(packed[at : at + OBSERVATION_BYTES])
        return made

    def place(self, at: int) -> tuple[float, float]:
        """x and y of one, m."""
        place = self._places[at]
        return place.real, place.imag

    def last_until(self, when: float) -> int:
        """The last one that is not after a time; −1: none. Calls mostly bring the newest."""
        times = self.times
        at = len(times) - 1
        while at >= 0 and times[at] > when + TIME_TOLERANCE:
            at -= 1
        return at

    def agrees(self, other: "Sighted") -> bool:
        """Whether others can be of the same agent: nowhere is it farther off than anything moves."""
        for time, place in zip(other.times, other._places, strict=True):
            before = self.last_until(time)
            for at in (before, before + 1):
                if not 0 <= at < len(self.times):
                    continue
                apart = abs(time - self.times[at])
                # Of one time there is one place: a call that comes twice says the same
                slack = JUMP_SLACK if apart > TIME_TOLERANCE else SAME_PLACE
                if abs(place - self._places[at]) > MAX_SPEED * apart + slack:
                    return False
        return True

    def insert(self, other: "Sighted") -> None:
        """Keeps others, but for those of a time that there is one of already."""
        for number, time in enumerate(other.times):
            at = self.last_until(time)
            if at >= 0 and time - self.times[at] <= TIME_TOLERANCE:
                continue
            self.times.insert(at + 1, time)
            self._places.insert(at + 1, other._places[number])
            self._records.insert(at + 1, other._records[number])

    def trim(self, cut: float) -> None:
        """Forgets what is older than a time."""
        drop = 0
        while drop < len(self.times) and self.times[drop] < cut:
            drop += 1
        if drop:
            del self.times[:drop], self._places[:drop], self._records[:drop]

    def history(self, time: float, recall: float) -> bytes:
        """Observations up to a time, those of the last ``recall`` seconds, and always the last one."""
        last = self.last_until(time)
        first = last
        while first > 0 and self.times[first - 1] >= time - recall:
            first -= 1
        return b"".join(self._records[first : last + 1]) if last >= 0 else b""
