"""The physics oracle: of several physics forecasts the one that turned out best. It needs the truth."""

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
"""Its name in tables."""
PHYSICS = (
    "constant-velocity-yaw",
    "constant-speed-yaw-rate",
    "constant-acceleration-yaw",
    "constant-acceleration-yaw-rate",
)
"""Names of the models that it chooses from, in the order that settles ties."""

_LIKELIEST = ("ade_ml_", "fde_ml_", "off_road_ml")
_OF_THE_LIKELIEST = (*_LIKELIEST, *(f"{MOVING}{name}" for name in _LIKELIEST))


class Criterion(StrEnum):
    """What "best" is measured by."""

    MEAN_DISTANCE = "mean_distance"
    """As the challenge and the paper describe it."""
    RMS_DISTANCE = "rms_distance"
    """As nuscenes-devkit's ``PhysicsOracle`` computes it (the Frobenius norm of the difference)."""


class OracleChoice(NamedTuple):
    """What the oracle took."""

    choice: Ints
    """[N], which of the M forecasts; −1 where none could be measured."""
    trajectory: Floats
    """[N, T, 2], m, that forecast; NaN without one."""


def physics_oracle(
    forecasts: Floats, truth: Floats, criterion: Criterion = Criterion.MEAN_DISTANCE
) -> OracleChoice:
    """Chooses for each instance the forecast nearest to the truth, the first of equals.

    Args:
        forecasts: [N, M, T, 2], m, ground frame; one with a point that is not finite is not chosen.
        truth: [N, T, 2], m, ground frame. Steps that are not finite do not count: so near the end of a
            track the choice is made by what there is.
        criterion: what is least.
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
    """Of the four physics forecasts of each pair, the one nearest to the truth on the mean.

    Args:
        mixtures: by the models' names, of N pairs, one mode; others than physics are left aside.
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
    """Those of ``instance_metrics`` that mean something of the oracle: it states one trajectory, and no
    density that could be judged."""
    return {name: values for name, values in metrics.items() if name.startswith(_OF_THE_LIKELIEST)}
