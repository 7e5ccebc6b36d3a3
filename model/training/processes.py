"""Processes of one run (torchrun); a run without torchrun is one process."""

import os
from collections.abc import Callable, Iterable
from typing import TypeVar, cast

import torch
import torch.distributed
from torch.nn import Parameter

from model.training.config import TrainingError

T = TypeVar("T")


def local_device() -> torch.device:
    """Return this process's GPU, or the CPU where there is none."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


def join(device: torch.device) -> bool:
    """Join the other processes of torchrun, if there are any; return whether this is the first one."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return True
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return torch.distributed.get_rank() == 0


def world() -> int:
    """Return the number of processes."""
    return torch.distributed.get_world_size() if torch.distributed.is_initialized() else 1


def rank() -> int:
    """Return the number of this process, counted from 0."""
    return torch.distributed.get_rank() if torch.distributed.is_initialized() else 0


def only_first(action: Callable[[], T]) -> T | None:
    """Run an action in the first process only, while the others wait for it.

    If the action fails, all processes raise: otherwise the others would wait for the first one in the next
    collective operation, without end.

    Returns:
        The action's result in the first process, None in the others.

    Raises:
        TrainingError: in the other processes, the action failed. The first process raises the action's error.
    """
    result: T | None = None
    error: Exception | None = None
    if rank() == 0:
        try:
            result = action()
        except Exception as raised:
            error = raised
    if world() > 1:
        failed = torch.tensor([int(error is not None)], device=_collective_device())
        torch.distributed.broadcast(failed, src=0)
        if failed.item() and error is None:
            raise TrainingError("the first process failed; its message gives the reason")
    if error is not None:
        raise error
    return result


def first_then_others(action: Callable[[], T]) -> T:
    """Run an action in the first process and then in the others, which find what the first has left.

    Raises:
        TrainingError: in the other processes, the action failed in the first one.
    """
    result = only_first(action)
    return cast("T", result) if rank() == 0 else action()


def average_gradients(parameters: Iterable[Parameter]) -> None:
    """Replace gradients by their means over all processes."""
    if world() == 1:
        return
    for parameter in parameters:
        if parameter.grad is not None:
            torch.distributed.all_reduce(parameter.grad)
            parameter.grad /= world()


def _collective_device() -> torch.device:
    """Return where tensors of collective operations have to be: NCCL takes those on GPUs only."""
    return local_device() if torch.distributed.get_backend() == "nccl" else torch.device("cpu")
