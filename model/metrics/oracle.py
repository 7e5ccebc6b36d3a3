"""The physics oracle: the best of several physics forecasts, chosen with knowledge of the truth."""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

import numpy as np
import torch

from model.arrays import Floats, Ints
from model.metrics.displacement import displacement_m
from model.metrics.evaluate import MOVING
from model.mixture import TrajectoryMixture

ORACLE = "physics-oracle"
"""Name in tables."""
PHYSICS = (
    "constant-velocity-yaw",
    "constant-speed-yaw-rate",
    "constant-acceleration-yaw",
    "constant-acceleration-yaw-rate",
)
"""Names of the models from which it chooses, in the order that settles ties."""

_LIKELIEST = ("ade_ml_", "fde_ml_", "off_road_ml")
_OF_THE_LIKELIEST = (*_LIKELIEST, *(f"{MOVING}{name}" for name in _LIKELIEST))


class Criterion(StrEnum):
    """Criterion of the choice."""

    MEAN_DISTANCE = "mean_distance"
    """Mean distance, as the challenge and the paper describe it."""
    RMS_DISTANCE = "rms_distance"
    """RMS distance, as nuscenes-devkit's ``PhysicsOracle`` computes it (Frobenius norm of the difference)."""


class OracleChoice(NamedTuple):
    """Choice of the oracle."""

    choice: Ints
    """[N], index among the M forecasts; −1 where none could be measured."""
    trajectory: Floats
    """[N, T, 2], m, the chosen forecast; NaN without one."""


def physics_oracle(
    forecasts: Floats, truth: Floats, criterion: Criterion = Criterion.MEAN_DISTANCE
) -> OracleChoice:
    """Choose for each instance the forecast nearest to the truth; ties go to the first.

    Args:
        forecasts: [N, M, T, 2], m, ground frame; one with a point that is not finite is not chosen.
        truth: [N, T, 2], m, ground frame. Steps that are not finite do not count, so that near the end
            of a track the choice depends on the steps that there are.
        criterion: criterion that the choice minimises.
    """
    usable = np.asarray(np.isfinite(forecasts).all(axis=(-2, -1)))  # [N, M]
    seen = np.asarray(np.isfinite(truth).all(axis=-1))  # [N, T]
    errors_m = np.where(seen[:, None], displacement_m(forecasts, truth[:, None]), 0.0)
    # The number of steps is the same for all M: sums rank as means, squares as their roots
    score = (
        errors_m.sum(axis=-1) if criterion is Criterion.MEAN_DISTANCE else np.square(errors_m).sum(axis=-1)
    )
    usable = np.asarray(usable & seen.any(axis=-1, keepdims=True))
    score = np.where(usable, score, np.inf)
    index = score.argmin(axis=1)
    known = np.asarray(usable.any(axis=1, keepdims=True))
    chosen = forecasts[np.arange(len(forecasts)), index]
    return OracleChoice(
        np.where(known[:, 0], index, -1).astype(np.int64), np.where(known[..., None], chosen, np.nan)
    )


def oracle_mixture(mixtures: Mapping[str, TrajectoryMixture], truth: Floats) -> TrajectoryMixture:
    """Return, for each pair, the physics forecast with the smallest mean distance from the truth.

    Args:
        mixtures: forecasts of N pairs, of one mode, by the models' names; models other than physics are
            ignored.
        truth: [N, T, 2], m, ground frame, finite.
    """
    four = [mixtures[name] for name in PHYSICS]
    trajectories = np.stack([one.most_likely_trajectory().numpy() for one in four], axis=1)
    choice = torch.from_numpy(physics_oracle(trajectories, truth).choice)
    rows = torch.arange(len(truth))
    return TrajectoryMixture(
        *(
            torch.stack([getattr(one, name) for one in four])[choice, rows]
            for name in ("log_weights", "means", "covariances", "origin")
        )
    )


def oracle_figures(metrics: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return those of ``instance_metrics`` that are meaningful for the oracle, which has no density."""
    return {name: values for name, values in metrics.items() if name.startswith(_OF_THE_LIKELIEST)}
