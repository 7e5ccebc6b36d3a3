"""Parts shared by the baselines, which forecast a single trajectory."""

import torch
from torch import Tensor

from model.forecaster import ModelInfo
from model.mixture import TrajectoryMixture
from model.scenes.scene import STEP_SECONDS


def step_times(info: ModelInfo, steps: int | None) -> Tensor:
    """Return the times of a forecast's steps: [T] float64, s ahead.

    Args:
        info: facts about the model.
        steps: T; None: ``info.steps``.

    Raises:
        ValueError: steps outside 1 … info.steps.
    """
    count = info.steps if steps is None else steps
    if not 1 <= count <= info.steps:
        raise ValueError(f"steps must be in 1 … {info.steps}, not {count}")
    return STEP_SECONDS * torch.arange(1, count + 1, dtype=torch.float64)


def unimodal(means: Tensor, covariances: Tensor, origin: Tensor) -> TrajectoryMixture:
    """Return a mixture of one mode.

    Args:
        means: [N, T, 2], m, relative to origin.
        covariances: [N, T, 2, 2], m².
        origin: [N, 2] float64, m, ground frame.
    """
    return TrajectoryMixture(
        log_weights=torch.zeros(len(means), 1, device=means.device),
        means=means[:, None].float(),
        covariances=covariances[:, None].float(),
        origin=origin,
    )
