"""Values that change over the steps of a run: the learning rate, and the weights of the losses' terms.

The annealing schedules are those of Trajectron++'s released settings.
"""

import math
from dataclasses import dataclass

from model.training.config import TrainingConfig
from model.training.objectives import LossWeights


@dataclass(frozen=True)
class Sigmoid:
    """A logistic curve from ``start`` to ``end``."""

    start: float
    end: float
    center: float
    """Step at which it is halfway."""
    width: float
    """Steps from halfway to about 3/4."""

    def __call__(self, step: int) -> float:
        """Return the value at a step, counted from 0."""
        return self.start + (self.end - self.start) / (1 + math.exp(-(step - self.center) / self.width))


KL_SHARE = Sigmoid(0.0, 1.0, center=400, width=100)
"""Share of the full weight of KL(q ‖ p)."""
Z_LOGIT_CLIP = Sigmoid(0.05, 5.0, center=300, width=60)
"""Clamp of the latent logits, in training only."""
ANNEALED = 2000
"""Steps after which both are at their ends; a run that starts from a trained network begins there."""


def loss_weights(config: TrainingConfig, step: int, epoch: int) -> LossWeights:
    """Return the weights of the losses' terms.

    Args:
        config: settings of the run.
        step: number of the step, counted from 0.
        epoch: number of its epoch, counted from 0.
    """
    annealed = step if config.start is None else step + ANNEALED
    displaced = epoch >= config.displacement_start
    return LossWeights(
        config.kl_weight * KL_SHARE(annealed),
        Z_LOGIT_CLIP(annealed),
        min_step_likelihood=config.min_step_likelihood,
        displacement=config.displacement_weight if displaced else 0.0,
        blind_kl=config.blind_kl_weight,
    )


def learning_rate(config: TrainingConfig, step: int, epoch_steps: int) -> float:
    """Return the learning rate of a step: warm-up, exponential decay, cooldown.

    Args:
        config: settings of the run.
        step: number of the step, counted from 0.
        epoch_steps: steps in an epoch.
    """
    rate = decayed(config.learning_rate, step, config.learning_rate_decay, config.min_learning_rate)
    if config.warmup_steps:
        rate *= min(1.0, (step + 1) / config.warmup_steps)
    return rate * cooldown(step, config.epochs * epoch_steps, config.cooldown_epochs * epoch_steps)


def decayed(base: float, step: int, decay: float = 0.9999, minimum: float = 1e-5) -> float:
    """Return a learning rate that decays exponentially with the steps, down to a minimum."""
    return max(base * decay**step, minimum)


def cooldown(step: int, steps: int, cooling: int) -> float:
    """Return a factor of the learning rate: 1, then linearly down to 0 over the last steps of a run.

    A network that is trained for few epochs gains more from such an end than from as many epochs at the full
    rate (Hägele et al. 2024).

    Args:
        step: number of the step, counted from 0.
        steps: steps of the whole run.
        cooling: steps of the cooldown at its end; 0: none.
    """
    return min(1.0, max(0, steps - step) / cooling) if cooling else 1.0
