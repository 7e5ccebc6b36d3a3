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


KL_SHARE = Sigmoid(0.0, 1.0, center=400, width=100)
"""Of the full weight of KL(q ‖ p)."""
Z_LOGIT_CLIP = Sigmoid(0.05, 5.0, center=300, width=60)
"""Bound of the latent logits, in training only."""
ANNEALED = 2000
"""Steps after which both are at their ends; a run that starts from a trained network begins there."""


def learning_rate(base: float, step: int, decay: float = 0.9999, least: float = 1e-5) -> float:
    """Exponential decay by step, with a floor."""
    return max(base * decay**step, least)


def cooldown(step: int, steps: int, cooling: int) -> float:
    """Factor of the learning rate: 1, then straight down to 0 over the last steps of a run.

    A network that is trained for few epochs gains more in such an end than in as many at the full rate
    (Hägele et al. 2024).

    Args:
        step: counted from 0.
        steps: of the whole run.
        cooling: how many at its end; 0: none.
    """
    return min(1.0, max(0, steps - step) / cooling) if cooling else 1.0
