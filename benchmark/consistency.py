"""Dispersion and convergence of the forecasts that one scene's agents got (table 2)."""

from collections.abc import Mapping

import numpy as np

from model.arrays import Floats, Ints
from model.data.scenes import SceneRecord
from model.metrics.consistency import (
    RANGES_M,
    complete,
    convergence_s,
    dispersion,
    errors_by_age_m,
    forecasts_by_age,
)

METRICS = (
    "dispersion_std_m",
    "dispersion_mean_m",
    "dispersion_rms_m",
    *(f"convergence_{range_m:g}m_s" for range_m in RANGES_M),
)
"""What is computed: the paper's D in its three forms, C(τ) in seconds."""


def consistency_metrics(
    record: SceneRecord, likeliest: Mapping[int, tuple[Ints, Floats]]
) -> dict[str, Floats]:
    """Each of ``METRICS`` [P], for the P instants of the scene's tracks that have a forecast of every age.

    Args:
        record: tells where the agents were.
        likeliest: by track, the frames at which forecasts were made [F], ascending, and these [F, T, 2], m.
    """
    parts: dict[str, list[Floats]] = {name: [] for name in METRICS}
    for track in sorted(likeliest):
        made_at, paths = likeliest[track]
        of = record.tracks[track]
        by_age = forecasts_by_age(made_at, paths, of.frames)
        known = complete(by_age)
        by_age, truth = by_age[known], of.position[known]
        apart = dispersion(by_age)
        parts["dispersion_std_m"].append(apart.std_m)
        parts["dispersion_mean_m"].append(apart.mean_m)
        parts["dispersion_rms_m"].append(apart.rms_m)
        errors_m = errors_by_age_m(by_age, truth)
        for range_m in RANGES_M:
            parts[f"convergence_{range_m:g}m_s"].append(convergence_s(errors_m, range_m))
    return {name: np.concatenate([np.zeros(0), *values]) for name, values in parts.items()}
