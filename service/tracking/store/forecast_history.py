"""What one model said of one agent."""

from bisect import bisect_left, bisect_right, insort
from typing import NamedTuple

from model.scenes.resample import TIME_TOLERANCE
from model.scenes.scene import STEP_SECONDS
from service.tracking.store.base import AGE_TOLERANCE, MAX_FORECASTS
from service.tracking.store.records import AGES, BLOCK

REACH = AGE_TOLERANCE + TIME_TOLERANCE
"""s; so far off its lag a forecast may have been made."""

_BLOCK_BYTES = BLOCK.itemsize
_ABSENT = b"\xff" * (3 * _BLOCK_BYTES)
"""NaN in every number."""
_NAN = float("nan")
_LAGS = tuple(
    (STEP_SECONDS * age, (age - 1) * _BLOCK_BYTES, (age + 2) * _BLOCK_BYTES) for age in range(1, AGES + 1)
)
"""s before an instant, and where the steps around it lie in a forecast's bytes."""


class Set(NamedTuple):
    """The forecasts for an instant."""

    made_at: list[float]
    """[A], s, by age; NaN where there is none."""
    blocks: list[bytes]
    """[A], the steps before, at and after the age."""
    complete: bool
    """Whether there is one of each age."""
    exact: bool
    """Whether those that there are were made on their lags."""


class Series:
    """Forecasts by when they were made, and which sets were settled."""

    def __init__(self) -> None:
        self.times: list[float] = []
        """s, ascending."""
        self.pending: list[float] = []
        """Instants whose set is complete but not settled yet, ascending."""
        self._settled: list[float] = []
        # Nothing in here is looked through by the garbage collector: there may be a million of them
        self._forecasts: dict[float, bytes] = {}

    def __len__(self) -> int:
        return len(self.times)

    def insert(self, made: float, forecast: bytes, steps: int) -> bool:
        """Keeps a forecast, unless there is one of that time already; whether it did."""
        times = self.times
        at = bisect_right(times, made + TIME_TOLERANCE)
        if at > 0 and made - times[at - 1] <= TIME_TOLERANCE:
            return False
        times.insert(at, made)
        self._forecasts[made] = forecast[: (steps + 2) * _BLOCK_BYTES]
        return True

    def trim(self, cut: float) -> None:
        """Forgets what is older than a time, and the oldest where there is too much."""
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
        """Whether a set is final."""
        at = bisect_left(self._settled, instant)
        return at < len(self._settled) and self._settled[at] == instant

    def wait(self, instant: float) -> None:
        """Notes a complete set that is not settled yet."""
        if instant not in self.pending:
            insort(self.pending, instant)

    def settle(self, instant: float) -> None:
        """Notes a set that is final."""
        insort(self._settled, instant)
        if instant in self.pending:
            self.pending.remove(instant)

    def may_be_complete(self, instant: float) -> bool:
        """False where it is plain that an age is missing: most sets of a late call's instants."""
        times = self.times
        return len(times) >= AGES and times[0] <= instant - _LAGS[-1][0] + REACH

    def gather(self, instant: float) -> Set:
        """The forecasts nearest to each lag of an instant."""
        forecasts = self._forecasts
        made_at, blocks = [], []
        complete = exact = True
        for seconds, start, stop in _LAGS:
            lag = instant - seconds
            made = lag if lag in forecasts else self._nearest(lag)
            block = b"" if made is None else forecasts[made][start:stop]
            if made is None or len(block) < len(_ABSENT):  # none, or it does not go so far
                complete = False
                made_at.append(_NAN)
                blocks.append(_ABSENT)
                continue
            exact = exact and -TIME_TOLERANCE <= made - lag <= TIME_TOLERANCE
            made_at.append(made)
            blocks.append(block)
        return Set(made_at, blocks, complete, exact)

    def _nearest(self, lag: float) -> float | None:
        """When the forecast nearest to a time was made, the older of two; None: none is near enough."""
        times = self.times
        after = bisect_right(times, lag)
        best, off = None, REACH
        if after > 0 and lag - times[after - 1] <= off:
            best, off = times[after - 1], lag - times[after - 1]
        if after < len(times):
            late = times[after] - lag
            if late < off or (best is None and late <= off):
                best = times[after]
        return best
