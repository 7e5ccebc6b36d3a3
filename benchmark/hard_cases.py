"""Hard cases: the pairs with the largest errors of the Kalman filter (table 3), and their forecasts."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmark.plan import HISTORY_FRAMES, PlannedScene
from benchmark.results import HARDEST_FDE
from model.arrays import Floats
from model.metrics.hard import hardest_of_known
from model.mixture import TrajectoryMixture
from model.scenes.scene import Raster

SHOWN = 6
"""Number of hard cases in a report."""


@dataclass(frozen=True)
class CaseForecast:
    """Forecast of one model."""

    weights: Floats
    """[K]"""
    modes: Floats
    """[K, T, 2], m, ground frame."""
    most_likely: Floats
    """[T, 2], m, ground frame."""
    fde_6s_m: float


@dataclass(frozen=True)
class HardCase:
    """One pair with all that its figure shows."""

    scene: str
    agent: str
    frame: int
    mismatch_m: float
    """FDE at 6 s of the Kalman filter."""
    raster: Raster
    history: Floats
    """[F, 2], m, oldest first, up to now."""
    truth: Floats
    """[T, 2], m."""
    others: Floats
    """[M, 2], m, present positions of the other agents."""
    forecasts: Mapping[str, CaseForecast]
    """Values by ``name@version``."""


def hardest_fde(fde_m: Floats, mismatch_m: Floats) -> dict[str, float]:
    """Return the mean FDE on the hardest 1, 2 and 3 % of the pairs, and on all.

    Args:
        fde_m: [N], m, at 6 s; NaN where there is no forecast.
        mismatch_m: [N], m, FDE of the Kalman filter; pairs where it is NaN are left out.

    Returns:
        ``fde_hardest_1_m`` … ``fde_hardest_3_m`` and ``fde_hardest_all_m``.
    """
    ranked = np.isfinite(mismatch_m)
    figures = {}
    if ranked.any():
        for name, share in HARDEST_FDE.items():
            figures[name] = _mean(fde_m[hardest_of_known(mismatch_m, share)])
    figures["fde_hardest_all_m"] = _mean(fde_m[ranked])
    return figures


def shown_cases(scenes: Sequence[PlannedScene], mismatch_m: Floats) -> list[tuple[PlannedScene, int]]:
    """Return the hardest pairs, the hardest first, at most one per agent: scene and index in the scene.

    Args:
        scenes: all scenes.
        mismatch_m: [N], m, FDE of the Kalman filter for all pairs in order.
    """
    where = [(scene, number) for scene in scenes for number in range(len(scene.pairs))]
    shown: list[tuple[PlannedScene, int]] = []
    seen: set[tuple[str, int]] = set()
    for index in np.argsort(np.where(np.isfinite(mismatch_m), -mismatch_m, np.inf), kind="stable").tolist():
        scene, number = where[index]
        agent = (scene.record.name, scene.pairs[number].track)
        if len(shown) == SHOWN or not np.isfinite(mismatch_m[index]):
            break
        if agent not in seen:
            seen.add(agent)
            shown.append((scene, number))
    return shown


def hard_case(
    scene: PlannedScene, number: int, mismatch_m: float, mixtures: Mapping[str, TrajectoryMixture]
) -> HardCase:
    """Return one pair with its forecasts.

    Args:
        scene: scene of the pair.
        number: index of the pair in its scene.
        mismatch_m: FDE at 6 s of the Kalman filter.
        mixtures: forecasts of this one pair, by ``name@version``.
    """
    record, pair = scene.record, scene.pairs[number]
    track = record.tracks[pair.track]
    past = (track.frames <= pair.frame) & (track.frames > pair.frame - HISTORY_FRAMES)
    others = [
        other.position[other.frames == pair.frame]
        for index, other in enumerate(record.tracks)
        if index != pair.track
    ]
    truth = scene.truth()[number]
    return HardCase(
        scene=record.name,
        agent=track.id,
        frame=pair.frame,
        mismatch_m=mismatch_m,
        raster=record.raster,
        history=track.position[past],
        truth=truth,
        others=np.concatenate([np.zeros((0, 2)), *others]),
        forecasts={key: _forecast(mixture, truth) for key, mixture in mixtures.items()},
    )


def _forecast(mixture: TrajectoryMixture, truth: Floats) -> CaseForecast:
    most_likely = mixture.most_likely_trajectory()[0].numpy()
    return CaseForecast(
        mixture.weights[0].double().numpy(),
        mixture.world_means[0].numpy(),
        most_likely,
        float(np.hypot(*(most_likely[-1] - truth[-1]))),
    )


def _mean(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float("nan")
