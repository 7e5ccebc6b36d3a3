"""Where batches come from, as the loop sees it."""

from typing import Protocol as Interface

from torch import Tensor

from model.forecaster import Features


class BatchSource(Interface):
    """Pairs of a split: their features, futures and curvature."""

    def __len__(self) -> int:
        """P, pairs."""
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
        """Features of n pairs, and their futures [n, T, 2], m, relative to now.

        Args:
            indices: [n] int64.
            turns: [n] rad, by which each pair's surroundings are turned; None: not at all.
        """
        ...
