"""Pairs to train on, as the loop sees them, and what is random in an epoch."""

from typing import Protocol as Interface

import torch
from torch import Tensor

from model.forecaster import Features

CURVED_RADIANS = 0.35
"""rad; a path that turns by more than that in its window counts as curved."""


class BatchSource(Interface):
    """The pairs of a split (``model.data.batches``)."""

    def __len__(self) -> int:
        """Return P, the number of pairs."""
        ...

    @property
    def turned(self) -> Tensor:
        """[P], rad, how far each pair's path turns from its oldest to its farthest frame."""
        ...

    @property
    def leaving(self) -> Tensor:
        """[P] bool, pairs that stood for as long as they were seen and leave within 6 s; on the CPU."""
        ...

    @property
    def paths(self) -> Tensor:
        """[P, T, 2], m, each pair's future in its agent's own frame: x ahead, y to the left; on the CPU."""
        ...

    def batch(self, indices: Tensor, turns: Tensor | None = None) -> tuple[Features, Tensor]:
        """Return features of n pairs, and their futures [n, T, 2], m, relative to now.

        Args:
            indices: [n] int64.
            turns: [n] rad, by which each pair's surroundings are turned; None: not at all.
        """
        ...


def epoch_order(turned: Tensor, curved_oversampling: int, seed: int, epoch: int) -> Tensor:
    """Return the indices of an epoch's pairs in its order; pairs with curved paths come several times.

    Most paths are straight, and a network that never turns is right about them.

    Args:
        turned: [P], rad, how far each pair's path turns.
        curved_oversampling: number of times that a curved one comes.
        seed: seed of the run.
        epoch: number of the epoch, counted from 0; each has its own order.
    """
    generator = torch.Generator().manual_seed(epoch_seed(seed, epoch))
    indices = torch.arange(len(turned))
    curved = indices[turned.abs() > CURVED_RADIANS]
    shown = torch.cat([indices, curved.repeat(curved_oversampling - 1)])
    return shown[torch.randperm(len(shown), generator=generator)]


def random_turns(count: int, generator: torch.Generator) -> Tensor:
    """Return [count] rad, random multiples of 15° (Trajectron++'s augmentation)."""
    return torch.randint(0, 24, (count,), generator=generator) * (torch.pi / 12)


def random_sides(count: int, generator: torch.Generator) -> Tensor:
    """Return [count] bool, each true with probability ½."""
    return torch.rand(count, generator=generator) < 0.5


def epoch_seed(seed: int, epoch: int) -> int:
    """Return a seed for one epoch.

    It does not depend on the epochs before, so that a resumed run goes on exactly as an uninterrupted one.
    """
    return (seed * 1_000_003 + epoch) % (1 << 63)
