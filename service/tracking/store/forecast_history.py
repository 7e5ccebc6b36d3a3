"""Forecasts that one model made for one agent."""

from bisect import bisect_left, bisect_right, insort
from typing import NamedTuple

from model.scenes.resample import TIME_TOLERANCE
from model.scenes.scene import STEP_SECONDS
from service.tracking.store.base import AGE_TOLERANCE, MAX_FORECASTS
from service.tracking.store.records import AGES, BLOCK

MAX_OFFSET = AGE_TOLERANCE + TIME_TOLERANCE
"""Seconds between the time of a forecast and its lag, at most."""

_BLOCK_BYTES = BLOCK.itemsize
_ABSENT = b"\xff" * (3 * _BLOCK_BYTES)
"""NaN in every number."""
_NAN = float("nan")
_LAGS = tuple(
    (STEP_SECONDS * age, (age - 1) * _BLOCK_BYTES, (age + 2) * _BLOCK_BYTES) for age in range(1, AGES + 1)
)
"""Seconds before an instant, and start and end of the steps around the instant in a forecast's bytes."""


class ForecastSet(NamedTuple):
    """Forecasts of all ages for one instant."""

    made_at: list[float]
    """[A], s, by age; NaN where there is no forecast."""
    blocks: list[bytes]
    """[A], the steps before, at and after the age."""
    complete: bool
    """True if there is a forecast of each age."""
    exact: bool
    """True if all forecasts were made exactly on their lags."""


class ForecastHistory:
    """Forecasts by time, and the instants whose sets have settled."""

    def __init__(self) -> None:
        self.times: list[float] = []
        """Times of the forecasts, s, ascending."""
        self.pending: list[float] = []
        """Instants whose set is complete but not settled, ascending."""
        self._settled: list[float] = []
        # Only floats and bytes, which the garbage collector does not traverse: there may be a million of them
        self._forecasts: dict[float, bytes] = {}

    def __len__(self) -> int:
        return len(self.times)

    def insert(self, made: float, forecast: bytes, steps: int) -> bool:
        """Store a forecast.

        Returns:
            False if there was already one of that time, which is kept.
        """
        times = self.times
        at = bisect_right(times, made + TIME_TOLERANCE)
        if at > 0 and made - times[at - 1] <= TIME_TOLERANCE:
            return False
        times.insert(at, made)
        self._forecasts[made] = forecast[: (steps + 2) * _BLOCK_BYTES]
        return True

    def trim(self, cut: float) -> None:
        """Drop forecasts older than a time, and the oldest beyond ``MAX_FORECASTS``."""
        times = self.times
        if not times or (times[0] >= cut and len(times) <= MAX_FORECASTS):
            return
        drop = max(bisect_left(times, cut), len(times) - MAX_FORECASTS)
        for made in times[:drop]:
            del self._forecasts[made]
        del times[:drop]
        for instants in (self._settled, self.pending):
            del instants[: bisect_left(instants, cut)]

    def is_settled(self, instant: float) -> bool:
        """Return whether the set of an instant is final."""
        at = bisect_left(self._settled, instant)
        return at < len(self._settled) and self._settled[at] == instant

    def mark_pending(self, instant: float) -> None:
        """Record that the set of an instant is complete but may still change."""
        if instant not in self.pending:
            insort(self.pending, instant)

    def mark_settled(self, instant: float) -> None:
        """Record that the set of an instant is final."""
        insort(self._settled, instant)
        if instant in self.pending:
            self.pending.remove(instant)

    def may_be_complete(self, instant: float) -> bool:
        """Return False if an age is certainly missing; a cheap check for most instants of a late call."""
        times = self.times
        return len(times) >= AGES and times[0] <= instant - _LAGS[-1][0] + MAX_OFFSET

    def collect(self, instant: float) -> ForecastSet:
        """Return the forecasts nearest to each lag of an instant."""
        forecasts = self._forecasts
        made_at, blocks = [], []
        complete = exact = True
        for seconds, start, stop in _LAGS:
            lag = instant - seconds
            made = lag if lag in forecasts else self._nearest(lag)
            block = b"" if made is None else forecasts[made][start:stop]
            if made is None or len(block) < len(_ABSENT):  # no forecast, or its horizon is too short
                complete = False
                made_at.append(_NAN)
                blocks.append(_ABSENT)
                continue
            exact = exact and -TIME_TOLERANCE <= made - lag <= TIME_TOLERANCE
            made_at.append(made)
            blocks.append(block)
        return ForecastSet(made_at, blocks, complete, exact)

    def _nearest(self, lag: float) -> float | None:
        """Return the time of the forecast nearest to a lag, the older one of a tie; None: all are too far."""
        times = self.times
        after = bisect_right(times, lag)
        best, offset = None, MAX_OFFSET
        if after > 0 and lag - times[after - 1] <= offset:
            best, offset = times[after - 1], lag - times[after - 1]
        if after < len(times):
            late = times[after] - lag
            if late < offset or (best is None and late <= offset):
                best = times[after]
        return best
