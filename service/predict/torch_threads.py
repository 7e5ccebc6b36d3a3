"""How many threads each part of the service computes with.

Every thread that runs a parallel section gets an OpenMP team of its own, and once the teams together are
more than the cores, their members sleep between sections instead of waiting awake: a forward of hundreds
of short sections then takes four times as long. So the forward's thread alone has a team.
"""

import torch

_CORES = torch.get_num_threads()
"""torch's choice when the process starts: the physical cores."""


def set_forward_threads(wanted: int | None) -> None:
    """For the forward's thread, to be called in it.

    Args:
        wanted: threads of its team; None: torch's choice.
    """
    torch.set_num_threads(wanted or _CORES)


def set_helper_threads() -> None:
    """For every other thread that computes, to be called in it: it does so alone."""
    torch.set_num_threads(1)
