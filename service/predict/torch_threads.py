"""Number of torch threads in each kind of thread of the service.

Every thread that runs a parallel section gets an OpenMP team of its own. Once the teams together exceed the
cores, their members sleep between sections instead of spinning: a forward of hundreds of short sections then
takes four times as long. Therefore only forwards have teams, and forwards that run at the same time share the
cores.
"""

import os

import torch

from service.cores import usable_cores, whole_cores

_CORES = torch.get_num_threads()
"""torch's choice when the process starts: the physical cores."""


def forward_widths(threads: int | None, workers: int | None = None) -> tuple[int, ...]:
    """Return the number of threads of a forward that runs alone, and of each of several at the same time.

    Two forwards of half the cores each finish more than one after the other with all: the threads of one
    never wait for each other while other work of the server has a core. With one thread there is no second
    number.

    Args:
        threads: the setting; None: as many as the quota allows, at most one for each physical core. More
            threads than a CPU quota allows would use it up early in each period and then stand still
            together.
        workers: as in ``worker_count``; without workers, two threads of this process run forwards.
    """
    alone = _threads(threads)
    return (alone,) if alone == 1 else (alone, max(1, alone // (worker_count(workers, threads) or 2)))


def worker_count(workers: int | None, threads: int | None) -> int:
    """Return the number of processes that run forwards; 0: threads of this process do.

    Args:
        workers: the setting; None: two, if a forward has two threads and the system has what they share.
        threads: as in ``forward_widths``.
    """
    if workers is not None:
        return workers
    return 2 if _threads(threads) > 1 and hasattr(os, "memfd_create") else 0


def _threads(threads: int | None) -> int:
    """Return the number of threads of a forward that runs alone."""
    if threads is not None:
        return threads
    limited = usable_cores() < len(os.sched_getaffinity(0))
    return min(_CORES, whole_cores()) if limited else _CORES


def set_helper_threads() -> None:
    """Make the calling thread compute without a team."""
    torch.set_num_threads(1)
