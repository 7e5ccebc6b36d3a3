"""Number of torch threads in each kind of thread of the service.

Every thread that runs a parallel section gets an OpenMP team of its own. Once the teams together exceed the
cores, their members sleep between sections instead of spinning: a forward of hundreds of short sections then
takes four times as long. Therefore only forwards have teams, and forwards that run at the same time share the
cores.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import torch

from service.cores import usable_cores, whole_cores

_CORES = torch.get_num_threads()
"""torch's choice when the process starts: the physical cores."""
_MAX_WORKERS = 4
"""Number of workers by default, at most: each takes some 330 MiB."""


class ForwardThreads(NamedTuple):
    """Numbers of forwards that may run at the same time, and of their threads."""

    total: int
    """Threads of all forwards together."""
    forwards: int
    """Forwards at the same time."""
    width: int
    """Threads of each."""
    workers: int
    """Processes that run them, as many as forwards; 0: threads of the server's process do."""


ONE_FORWARD = ForwardThreads(1, 1, 1, 0)


def forward_threads(threads: int | None = None, workers: int | None = None) -> ForwardThreads:
    """Return how forwards share the cores.

    Several forwards with few threads each finish more than one with all: threads of one forward wait for each
    other after each of its hundreds of short sections.

    Args:
        threads: threads of all forwards together; None: as many as the quota allows, at most one for each
            physical core. More threads than a CPU quota allows would use it up early in each period and then
            stand still together.
        workers: number of processes; None: two to four, so that no thread is left over, or few; none where
            there is one thread, or where the system lacks what processes share.
    """
    total = _threads(threads)
    if workers is None:
        workers = 0
        if total > 1 and hasattr(os, "memfd_create"):
            workers = max(range(2, min(total, _MAX_WORKERS) + 1), key=lambda n: (total // n * n, n))
    forwards = workers or min(total, 2)
    return ForwardThreads(total, forwards, max(1, total // forwards), workers)


def _threads(threads: int | None) -> int:
    """Return the number of threads of all forwards together."""
    if threads is not None:
        return threads
    limited = usable_cores() < len(os.sched_getaffinity(0))
    return min(_CORES, whole_cores()) if limited else _CORES


def set_helper_threads() -> None:
    """Make the calling thread compute without a team."""
    torch.set_num_threads(1)


def make_cutters(width: int) -> ThreadPoolExecutor | None:
    """Return threads that cut map patches for forwards of so many threads; None: the forward's own does."""
    if width == 1:
        return None
    return ThreadPoolExecutor(width, thread_name_prefix="patches", initializer=set_helper_threads)
