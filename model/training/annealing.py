"""Weights that change over the training steps (Trajectron++, released settings)."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Sigmoid:
    """From ``start`` to ``end`` along a logistic curve."""

    start: float
    end: float
    center: float
    """Step at which it is halfway."""
    width: float
    """Steps from halfway to about 3/4."""

    def __call__(self, step: int) -> float:
        """The value at a step, counted from 0."""
        return self.start + (self.end - self.start) / (1 + math.exp(-(step - self.center) / self.width))


KL_WEIGHT = Sigmoid(0.0, 100.0, center=400, width=100)
"""Weight of KL(q ‖ p)."""
Z_LOGIT_CLIP = Sigmoid(0.05, 5.0, center=300, width=60)
"""Bound of the latent logits, in training only."""


def learning_rate(base: float, step: int, decay: float = 0.9999, least: float = 1e-5) -> float:
    """Exponential decay by step, with a floor."""
    return max(base * decay**step, least)
