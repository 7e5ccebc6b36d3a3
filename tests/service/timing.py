"""CPU time of one call, for tests that hold what is hostile to cost next to nothing."""

import gc
import time
from collections.abc import Callable


def cpu_seconds(call: Callable[[], object], tries: int = 3) -> float:
    """The least CPU time of this thread in some tries, s.

    The least, since a busy machine slows single tries many times over; of this thread, and with what was
    there before kept out of the collector's rounds, since what other tests have left is not the call's doing.
    """
    seconds = []
    gc.collect()
    gc.freeze()
    try:
        for _ in range(tries):
            started = time.thread_time()
            call()
            seconds.append(time.thread_time() - started)
    finally:
        gc.unfreeze()
    return min(seconds)
