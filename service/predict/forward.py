"""One forward of a model over the agents of a batch, in whatever thread or process it runs."""

import time
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np
import torch

from model.arrays import Bools
from model.forecaster import Context, Forecaster, ModelInfo, Prepared, complete
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentType

_CUT_IN_THREADS = 8
"""Agents of a batch from which on map patches are cut in several threads."""


class Forwarded(NamedTuple):
    """Result of a forward, and its time."""

    mixture: TrajectoryMixture
    started: float
    """Start by ``time.perf_counter``."""
    seconds: float
    """Duration."""
    patches: float
    """Seconds of these in which map patches were cut."""


class Batch(NamedTuple):
    """The agents of a forward, and how it is to run."""

    agent_type: AgentType
    """Type of all agents."""
    context: Context
    """The context that the parts were prepared with."""
    parts: Sequence[Prepared]
    steps: int


def forward(forecaster: Forecaster, batch: Batch, cutters: Executor | None = None) -> Forwarded:
    """Run one forward of a forecaster over the joined parts of a batch.

    Args:
        forecaster: the forecaster.
        batch: the batch.
        cutters: threads that cut map patches of many agents; None: the calling one does.

    Returns:
        The mixture and the time that it took.

    Raises:
        RuntimeError: the mixture is not one of the expected agents, modes and steps.
    """
    started = time.perf_counter()
    with torch.inference_mode():
        agents = sum(map(len, batch.parts))
        features = complete(batch.parts, cutters if agents >= _CUT_IN_THREADS else None)
        patches = time.perf_counter() - started
        mixture = forecaster.forecast(features, batch.agent_type, batch.context, batch.steps)
    require_shapes(forecaster.info, mixture, agents, batch.steps)
    return Forwarded(mixture, started, time.perf_counter() - started, patches)


def require_shapes(info: ModelInfo, mixture: TrajectoryMixture, agents: int, steps: int) -> None:
    """Refuse a mixture of unexpected shapes.

    Args:
        info: the model that returned it.
        mixture: the mixture.
        agents: number of agents it must have.
        steps: number of steps it must have.

    Raises:
        RuntimeError: the mixture is not one of these agents and steps and the model's modes.
    """
    modes = info.modes
    expected = ((agents, modes), (agents, modes, steps, 2), (agents, modes, steps, 2, 2), (agents, 2))
    tensors = (mixture.log_weights, mixture.means, mixture.covariances, mixture.origin)
    shapes = tuple(tuple(tensor.shape) for tensor in tensors)
    if shapes != expected:
        raise RuntimeError(
            f"{info.name} must forecast {agents} agents with {modes} modes of {steps} steps, but its "
            f"log-weights, means, covariances and origins are of the shapes {shapes}"
        )


def finite(mixture: TrajectoryMixture) -> Bools:
    """Return which agents' forecasts are finite, and so can be sent: [N]."""
    with np.errstate(over="ignore"):
        weights = np.exp(mixture.log_weights.numpy().astype(np.float64))
    mask: Bools = np.isfinite(weights).all(axis=1) & (weights.sum(axis=1) > 0)
    for values in (mixture.means, mixture.covariances, mixture.origin):
        mask &= np.isfinite(values.numpy()).all(axis=tuple(range(1, values.ndim)))
    return mask
