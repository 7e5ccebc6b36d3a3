"""A circuit breaker: what failed several times in a row is left alone for a while."""

from collections.abc import Callable


class Circuit:
    """Open, it lets nothing through until a pause is over, and then one call, whose fate decides.

    It never waits; all of it is on the event loop.
    """

    def __init__(self, failures: int, pause_s: float, max_pause_s: float, clock: Callable[[], float]) -> None:
        """
        Args:
            failures: in a row that open it.
            pause_s: s of the first pause; each further one is twice as long.
            max_pause_s: s of the longest.
            clock: s.
        """
        self._limit = failures
        self._first_pause = pause_s
        self._max_pause = max_pause_s
        self._clock = clock
        self._failures = 0
        self._pause = pause_s
        self._open_until: float | None = None
        self._probing = False

    @property
    def ready(self) -> bool:
        """Whether a call may be made now."""
        return self._open_until is None or (not self._probing and self._clock() >= self._open_until)

    def begin(self) -> bool:
        """A call is made, as ``ready`` allowed; whether it is the one that decides."""
        self._probing = self._open_until is not None
        return self._probing

    def end(self, probe: bool, success: bool) -> None:
        """A call has succeeded or failed.

        Args:
            probe: what ``begin`` had returned for it.
            success: how it went.
        """
        if probe:
            self._probing = False
            if success:
                self._open_until, self._failures, self._pause = None, 0, self._first_pause
            else:
                self._open(min(2 * self._pause, self._max_pause))
        elif self._open_until is None:  # otherwise it is an old call, and the next one decides
            self._failures = 0 if success else self._failures + 1
            if self._failures >= self._limit:
                self._open(self._first_pause)

    def _open(self, pause_s: float) -> None:
        self._pause = pause_s
        self._open_until = self._clock() + pause_s
