"""All metrics of a batch of forecasts, per instance, under stable names."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from model.arrays import Bools, Floats
from model.metrics import density, displacement, multimodal, offroad
from model.mixture import TrajectoryMixture, merge_modes
from model.scenes.scene import Raster

SAMPLES: Final = 2000
"""Trajectories that the paper draws for ADE-f, FDE-f and OffR-f."""

MERGED_SHARE: Final = 0.9
"""Share of the probability; ``merged_modes_90`` is the number of merged modes that hold it."""
MERGED_TOP_K: Final = (5, 10)
"""k of figures of merged modes; for k = 1 there are figures by horizon."""

MOVING: Final = "moving_"
"""Prefix of figures without the agents that stood."""
MOVING_FIGURES: Final = (
    "ade_ml_6s_m",
    "fde_ml_6s_m",
    "off_road_ml",
    "off_road_f",
    "nll",
    "inside_90",
    *(f"inside_90_{h}s" for h in displacement.HORIZONS_S),
    *(f"{name}_{k}{unit}" for name, unit in (("min_ade", "_m"), ("miss_rate", "")) for k in (5, 10)),
    *(f"merged_{name}_{k}{unit}" for name, unit in (("min_ade", "_m"), ("miss_rate", "")) for k in (5, 10)),
    "merged_min_fde_5_m",
    "merged_brier_min_fde_5_m",
    "merged_modes_90",
    "merged_first_weight",
    "ade_merged_6s_m",
    "fde_merged_6s_m",
)
"""Figures that are also given without the agents that stood."""

LEAVING_M: Final = 2.0
LEAVING_STEP: Final = 6
"""A mode leaves if it is more than 2 m away after 3 s, as hardly any should for standing agents."""

_CHUNK_POINTS: Final = 1 << 18
"""Sampled positions evaluated at once."""


def instance_metrics(
    mixture: TrajectoryMixture,
    truth: Floats,
    rasters: Sequence[Raster | None] | None = None,
    seeds: Sequence[int] | None = None,
    *,
    samples: int = SAMPLES,
    draws: int = density.DRAWS,
    noise_m: float = density.LABEL_NOISE_M,
    stood: Bools | None = None,
) -> dict[str, Floats]:
    """Return metrics of N forecasts by name, each [N]; their means over instances are the tables' figures.

    For h in 1 … 6 (up to T), k in 1, 5, 10, p in 50, 90, 99; "whole" is up to step T:

    - ``ade_ml_{h}s_m``, ``fde_ml_{h}s_m``: m, for the most likely trajectory.
    - ``min_ade_{k}_m``, ``min_fde_{k}_m``, ``miss_rate_{k}``: whole, as in nuscenes-devkit.
    - for the merged modes (``model.mixture.merge_modes``): ``ade_merged_{h}s_m``, ``fde_merged_{h}s_m``: m,
      for the likeliest; for k in 5, 10 ``merged_min_ade_{k}_m``, ``merged_min_fde_{k}_m``,
      ``merged_miss_rate_{k}`` and ``merged_brier_min_fde_{k}_m``; ``merged_modes_90``: number that hold 90 %
      of the probability; ``merged_first_weight``: weight of the likeliest. All other metrics are of the modes
      as forecast.
    - ``leaving_weight_3s``: probability of the modes that are more than ``LEAVING_M`` from now after 3 s.
    - ``nll``: nats, mean over the steps; ``nll_{h}s``: at that step; ``nll_joint``: whole trajectory. They
      are for the labelled position: the mixture is widened by ``noise_m`` (see ``density``).
    - with rasters: ``off_road_ml``: 1 or 0, the most likely trajectory; NaN without a map.
    - with seeds and ``samples``: ``ade_f_{h}s_m``, ``fde_f_{h}s_m``: m, mean over the samples; with rasters
      also ``off_road_f``, share of the samples.
    - with seeds and ``draws``: ``inside_{p}``: share of the steps at which the truth lies inside the p %
      highest-density region of the widened mixture; ``inside_{p}_{h}s``: 1 or 0, at that step.
    - with ``stood``: ``moving_{figure}``, for each of ``MOVING_FIGURES``; NaN for agents that stood.

    Where a step of the truth is not finite, the metrics that use it are NaN.

    Args:
        mixture: forecasts of N agents, K modes, T steps; on any device.
        truth: [N, T, 2], m, ground frame.
        rasters: N maps (instances of a scene may share one), or None for no off-road rates.
        seeds: N seeds, determined by the instance and not by its place in a batch, so that figures do not
            depend on batching; or None for no sampled metrics.
        samples: S, trajectories drawn for ADE-f, FDE-f and OffR-f; 0: none of these.
        draws: positions drawn for calibration; 0: no calibration.
        noise_m: standard deviation of labelled positions, m, for likelihood and calibration; 0: the plain
            mixture.
        stood: [N], from ``standing.stood``; None: no figures for moving agents.

    Raises:
        ValueError: sizes do not match, or N is 0.
    """
    count, _, steps = mixture.means.shape[:3]
    if not count:
        raise ValueError("there are no instances to evaluate")
    if truth.shape != (count, steps, 2):
        raise ValueError(f"truth of {count} forecasts of {steps} steps cannot be {truth.shape}")
    if seeds is not None and len(seeds) != count:
        raise ValueError(f"{count} instances need as many seeds, not {len(seeds)}")
    if stood is not None and stood.shape != (count,):
        raise ValueError(f"whether {count} agents stood cannot be {stood.shape}")
    mixture = TrajectoryMixture(
        mixture.log_weights.detach().cpu(),
        mixture.means.detach().cpu(),
        mixture.covariances.detach().cpu(),
        mixture.origin.detach().cpu(),
    )
    most_likely = mixture.most_likely_trajectory().numpy()
    result = _by_horizon("ml", displacement.displacement_m(most_likely, truth))
    modes = mixture.world_means.numpy()
    probabilities = mixture.weights.double().numpy()
    for k in multimodal.TOP_K:
        result[f"min_ade_{k}_m"] = multimodal.min_ade_m(modes, probabilities, truth, k)
        result[f"min_fde_{k}_m"] = multimodal.min_fde_m(modes, probabilities, truth, k)
        result[f"miss_rate_{k}"] = multimodal.missed(modes, probabilities, truth, k)
    result |= _merged(mixture, truth)
    if steps >= LEAVING_STEP:
        leaving = mixture.means[:, :, LEAVING_STEP - 1].norm(dim=-1) > LEAVING_M
        result["leaving_weight_3s"] = (mixture.weights.double() * leaving).sum(dim=1).numpy()
    result |= _likelihood(mixture, truth, noise_m)
    if rasters is not None:
        result["off_road_ml"] = offroad.off_road_of_each(rasters, most_likely)
    if seeds is not None and samples:
        result |= _sampled(mixture, truth, rasters, seeds, samples)
    if seeds is not None and draws:
        result |= _calibration(mixture, truth, seeds, draws, noise_m)
    if stood is not None:
        moving = {name: result[name] for name in MOVING_FIGURES if name in result}
        result |= {f"{MOVING}{name}": np.where(stood, np.nan, values) for name, values in moving.items()}
    return result


def _merged(mixture: TrajectoryMixture, truth: Floats) -> dict[str, Floats]:
    """Return metrics of the merged modes by name, [N] each; units as the names say.

    The padding of merged mixtures is harmless: it ranks last and repeats an existing mode.
    """
    merged = merge_modes(mixture).mixture
    likeliest = merged.most_likely_trajectory().numpy()
    result = _by_horizon("merged", displacement.displacement_m(likeliest, truth))
    modes, probabilities = merged.world_means.numpy(), merged.weights.double().numpy()
    for k in MERGED_TOP_K:
        result[f"merged_min_ade_{k}_m"] = multimodal.min_ade_m(modes, probabilities, truth, k)
        result[f"merged_min_fde_{k}_m"] = multimodal.min_fde_m(modes, probabilities, truth, k)
        result[f"merged_miss_rate_{k}"] = multimodal.missed(modes, probabilities, truth, k)
        result[f"merged_brier_min_fde_{k}_m"] = multimodal.brier_min_fde_m(modes, probabilities, truth, k)
    result["merged_modes_90"] = multimodal.modes_holding(probabilities, MERGED_SHARE)
    result["merged_first_weight"] = probabilities.max(axis=1)
    return result


def _by_horizon(kind: str, errors_m: Floats) -> dict[str, Floats]:
    """Return ADE and FDE from errors [N, T], m."""
    result = {}
    for h in displacement.horizons_within(errors_m.shape[1]):
        result[f"ade_{kind}_{h}s_m"] = displacement.ade_m(errors_m, h)
        result[f"fde_{kind}_{h}s_m"] = displacement.fde_m(errors_m, h)
    return result


def _likelihood(mixture: TrajectoryMixture, truth: Floats, noise_m: float) -> dict[str, Floats]:
    steps = density.nll(mixture, truth, noise_m)
    result = {"nll": steps.mean(axis=1), "nll_joint": density.joint_nll(mixture, truth, noise_m)}
    for h in displacement.horizons_within(steps.shape[1]):
        result[f"nll_{h}s"] = steps[:, displacement.horizon_steps(h) - 1]
    return result


def _sampled(
    mixture: TrajectoryMixture,
    truth: Floats,
    rasters: Sequence[Raster | None] | None,
    seeds: Sequence[int],
    samples: int,
) -> dict[str, Floats]:
    """Return sampled metrics, computed in chunks: the samples of a large batch would not fit into memory."""
    parts = []
    chunk = max(1, _CHUNK_POINTS // (samples * truth.shape[1]))
    for start in range(0, len(truth), chunk):
        some = slice(start, start + chunk)
        drawn = mixture[some].sample(samples, seeds[some]).numpy()
        part = _by_horizon("f", displacement.expected_displacement_m(drawn, truth[some]))
        if rasters is not None:
            part["off_road_f"] = offroad.expected_off_road(rasters[some], drawn)
        parts.append(part)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _calibration(
    mixture: TrajectoryMixture, truth: Floats, seeds: Sequence[int], draws: int, noise_m: float
) -> dict[str, Floats]:
    rank = density.density_rank(mixture, truth, seeds, noise_m, draws)
    result = {}
    for level in density.LEVELS:
        inside, percent = density.inside_region(rank, level), round(100 * level)
        result[f"inside_{percent}"] = inside.mean(axis=1)
        for h in displacement.horizons_within(truth.shape[1]):
            result[f"inside_{percent}_{h}s"] = inside[:, displacement.horizon_steps(h) - 1]
    return result
