"""Which pairs an epoch shows, and in which order."""

import torch
from torch import Tensor

CURVED_RADIANS = 0.35
"""rad; a path that turns more than that in its window counts as curved."""


def epoch_order(
    turned: Tensor,
    curved_copies: int,
    seed: int,
    epoch: int,
) -> Tensor:
    """Indices of the pairs in the epoch's order; pairs of curved paths come several times.

    Most paths are straight, and a network that never turns is right about them.

    Args:
        turned: [P], rad, how far each pair's path turns.
        curved_copies: how often a curved one comes.
        seed: of the run.
        epoch: counted from 0; each has its own order.
    """
    generator = torch.Generator().manual_seed(epoch_seed(seed, epoch))
    indices = torch.arange(len(turned))
    curved = indices[turned.abs() > CURVED_RADIANS]
    shown = torch.cat([indices, curved.repeat(curved_copies - 1)])
    return shown[torch.randperm(len(shown), generator=generator)]


def random_turns(count: int, generator: torch.Generator) -> Tensor:
    """[count] rad, random multiples of 15° (Trajectron++'s augmentation)."""
    return torch.randint(0, 24, (count,), generator=generator) * (torch.pi / 12)


def random_sides(count: int, generator: torch.Generator) -> Tensor:
    """[count] bool, each true as often as not."""
    return torch.rand(count, generator=generator) < 0.5


def epoch_seed(seed: int, epoch: int) -> int:
    """A seed for one epoch: what is random in it does not hang on the epochs before, so that a resumed
    run goes on exactly as an unbroken one."""
    return (seed * 1_000_003 + epoch) % (1 << 63)
