"""The processes of one run (torchrun); a run without torchrun is one process."""

import os
from collections.abc import Callable, Iterable
from typing import TypeVar

import torch
import torch.distributed
from torch.nn import Parameter

T = TypeVar("T")


def join(device: torch.device) -> bool:
    """Joins the other processes of torchrun, if any; whether this is the first."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return True
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return torch.distributed.get_rank() == 0


def first_alone(action: Callable[[], T]) -> T:
    """Does something in the first process, and then in the others, which find what the first has left."""
    if world() == 1:
        return action()
    if rank() == 0:
        result = action()
        torch.distributed.barrier()
        return result
    torch.distributed.barrier()
    return action()


def world() -> int:
    """How many there are."""
    return torch.distributed.get_world_size() if torch.distributed.is_initialized() else 1


def rank() -> int:
    """Which one this is, counted from 0."""
    return torch.distributed.get_rank() if torch.distributed.is_initialized() else 0


def average_gradients(parameters: Iterable[Parameter]) -> None:
    """Means of the gradients over all processes."""
    if world() == 1:
        return
    for parameter in parameters:
        if parameter.grad is not None:
            torch.distributed.all_reduce(parameter.grad)
            parameter.grad /= world()
