"""Consistency metrics of the forecasts for one instant (Ben-Younes et al. 2022, section 4).

``model.metrics`` defines them; this module applies them to the records of the track memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from model.arrays import Bools, Floats
from model.metrics.consistency import RANGES_M, Dispersion, convergence_s, dispersion, errors_by_age_m
from model.metrics.displacement import displacement_m
from model.scenes.resample import TIME_TOLERANCE
from model.scenes.scene import STEP_SECONDS
from service.tracking.store.records import AGES, COMPLETE, NEWLY, SETTLED, unpack_instants

AGES_S = STEP_SECONDS * np.arange(1, AGES + 1)
"""[A], s."""


@dataclass(frozen=True)
class InstantMetrics:
    """Metrics of P instants with forecasts of A ages."""

    time: Floats
    """[P], s, of the observation."""
    complete: Bools
    """[P]."""
    settled: Bools
    """[P]."""
    newly: Bools
    """[P], settled by the call itself."""
    dispersion: Dispersion
    """[P] each, m; NaN where the set is not complete."""
    convergence_s: Floats
    """[P, R] for each of ``RANGES_M``, s; NaN where the set is not complete."""
    errors_m: Floats
    """[P, A]; NaN where there is no forecast."""
    nearest: Bools
    """[P, A]; True where the most likely of the five stored modes was the nearest to the observation."""

    def __len__(self) -> int:
        """Return P."""
        return len(self.time)

    def rows(self, rows: Sequence[int]) -> "InstantMetrics":
        """Return some of the instants."""
        index = np.array(rows, dtype=np.int64)
        std_m, mean_m, rms_m, known = self.dispersion
        selected = Dispersion(std_m[index], mean_m[index], rms_m[index], known[index])
        others = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "dispersion"}
        return InstantMetrics(dispersion=selected, **others)


def instant_metrics(packed: bytes) -> InstantMetrics:
    """Return the metrics of instants.

    Args:
        packed: P records of ``records.INSTANT``.
    """
    instants = unpack_instants(packed)
    points, others = _at_the_instant(
        instants["time"], instants["made_at"], instants["blocks"]["point"], instants["blocks"]["others"]
    )
    truth = instants["position"]
    errors_m = errors_by_age_m(points, truth)
    others_m = displacement_m(points[:, :, None] + others, truth[:, None, None])
    flags = instants["flags"]
    complete = flags & COMPLETE > 0
    return InstantMetrics(
        time=instants["time"],
        complete=complete,
        settled=flags & SETTLED > 0,
        newly=flags & NEWLY > 0,
        dispersion=dispersion(points),
        convergence_s=np.stack([convergence_s(errors_m, range_m) for range_m in RANGES_M], axis=1),
        errors_m=errors_m,
        nearest=errors_m <= np.where(np.isnan(others_m), np.inf, others_m).min(axis=2),
    )


def _at_the_instant(time: Floats, made_at: Floats, points: Floats, others: Floats) -> tuple[Floats, Floats]:
    """Interpolate forecasts at the exact time of the instant.

    The interpolation between steps is linear; beyond the last step it extrapolates the last segment.

    Args:
        time: [P], s.
        made_at: [P, A], s.
        points: [P, A, 3, 2], m, at the steps before, at and after the age; NaN in the last slot if the
            forecast ends at the age.
        others: [P, A, 3, M, 2], m, relative to the points.

    Returns:
        [P, A, 2] and [P, A, M, 2], m.
    """
    offset = (time[:, None] - made_at - AGES_S) / STEP_SECONDS  # in steps, mostly 0
    weight = np.where(np.abs(offset) <= TIME_TOLERANCE / STEP_SECONDS, 0.0, offset)
    if not np.nan_to_num(weight).any():  # frames at a steady rate
        return points[:, :, 1], others[:, :, 1].astype(np.float64)

    def interpolate(values: Floats) -> Floats:
        w = weight.reshape(weight.shape + (1,) * (values.ndim - 3))
        before, at, after = values[:, :, 0], values[:, :, 1], values[:, :, 2]
        forward = np.where(np.isnan(after), at - before, after - at)
        slope = np.where(w < 0, at - before, np.where(w > 0, forward, 0.0))
        result: Floats = at + np.where(w == 0, 0.0, w * slope)
        return result

    return interpolate(points), interpolate(others.astype(np.float64))
