"""Number of torch threads in each kind of thread of the service.

Every thread that runs a parallel section gets an OpenMP team of its own. Once the teams together exceed the
cores, their members sleep between sections instead of spinning: a forward of hundreds of short sections then
takes four times as long. Therefore only the thread of the forward has a team.
"""

import os

import torch

from service.cores import usable_cores, whole_cores

_CORES = torch.get_num_threads()
"""torch's choice when the process starts: the physical cores."""


def forward_threads(threads: int | None) -> int | None:
    """Return the number of threads of a forward; None: one for each physical core.

    More threads than a CPU quota allows would use it up early in each period and then stand still together.

    Args:
        threads: the setting; None: as many as the quota allows, at most one for each physical core.
    """
    if threads is not None or usable_cores() >= len(os.sched_getaffinity(0)):
        return threads
    return min(_CORES, whole_cores())


def set_forward_threads(threads: int | None) -> None:
    """Set the team size of the calling thread, which is that of the forward.

    Args:
        threads: the number of threads; None: torch's choice.
    """
    torch.set_num_threads(threads or _CORES)


def set_helper_threads() -> None:
    """Make the calling thread compute without a team."""
    torch.set_num_threads(1)
