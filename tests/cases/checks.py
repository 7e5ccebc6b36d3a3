"""Quantities of one forecast, in the frame of the car at the start."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from cab_forecast import Forecast, Status
from model.arrays import Floats, Ints
from model.metrics.offroad import driveable
from model.mixture import TrajectoryMixture, merge_modes
from model.scenes.scene import STEP_SECONDS, Raster
from tests.cases.case import Frame

SAMPLES = 2000
_SEED = 7
LEAD_SIZE = (4.6, 2.0)
"""m, length and width of a standing lead."""
CAR_HALF_WIDTH = 1.0
"""m, half the width of the forecast car."""
MOVES = 2.0
"""m at 6 s beyond which a mode counts as moving."""
_TURN_LEAST = 0.5
"""Min m travelled in the last second for a trajectory to have a direction."""


@dataclass(frozen=True)
class LocalForecast:
    """A mixture of K modes over T steps, in the frame of the car at the start."""

    frame: Frame
    status: Status
    mode_ids: Ints
    """[K]."""
    weights: Floats
    """[K], summing to 1."""
    means: Floats
    """[K, T, 2], m."""
    covariances: Floats
    """[K, T, 2, 2], m²."""

    @classmethod
    def of(cls, forecast: Forecast, frame: Frame) -> "LocalForecast":
        """Return an agent's forecast in the frame of its start, weights normalized."""
        return cls(
            frame,
            forecast.status,
            forecast.mode_ids,
            forecast.weights / forecast.weights.sum(),
            frame.to_local(forecast.means),
            frame.covariances_to_local(forecast.covariances),
        )

    @property
    def likeliest(self) -> Floats:
        """Return the means of the most likely mode: [T, 2], m."""
        path: Floats = self.means[self.weights.argmax()]
        return path

    @cached_property
    def mixture(self) -> TrajectoryMixture:
        """Return the forecast as the model's own mixture, of one agent."""
        return TrajectoryMixture(
            torch.from_numpy(self.weights[None]).clamp_min(1e-30).log().float(),
            torch.from_numpy(self.means[None]).float(),
            torch.from_numpy(self.covariances[None]).float(),
            torch.zeros(1, 2, dtype=torch.float64),
        )

    @cached_property
    def samples(self) -> Floats:
        """Return 2000 samples of the mixture with a fixed seed: [2000, T, 2], m."""
        drawn: Floats = self.mixture.sample(SAMPLES, [_SEED])[0].numpy()
        return drawn


def step(seconds: float) -> int:
    """Return the index of the step ``seconds`` ahead."""
    return round(seconds / STEP_SECONDS) - 1


def share_moving(forecast: LocalForecast, metres: float, seconds: float) -> float:
    """Return the share of samples farther than ``metres`` from the start after ``seconds``."""
    return float((np.linalg.norm(forecast.samples[:, step(seconds)], axis=-1) > metres).mean())


def share_of_moving_ahead(forecast: LocalForecast, metres: float, seconds: float, within: float) -> float:
    """Return the share, among samples farther than ``metres`` away after ``seconds``, that lies within
    ``within`` rad of the heading; NaN if no sample moves that far."""
    end = forecast.samples[:, step(seconds)]
    moving = end[np.linalg.norm(end, axis=-1) > metres]
    if not len(moving):
        return float("nan")
    return float((np.abs(np.arctan2(moving[:, 1], moving[:, 0])) <= within).mean())


def weight_of_moving_ahead(forecast: LocalForecast, metres: float, seconds: float, within: float) -> float:
    """Return ``share_of_moving_ahead`` of the modes' means, weighted."""
    end = forecast.means[:, step(seconds)]
    moving = np.linalg.norm(end, axis=-1) > metres
    if not moving.any():
        return float("nan")
    ahead = moving & (np.abs(np.arctan2(end[:, 1], end[:, 0])) <= within)
    return float(forecast.weights[ahead].sum() / forecast.weights[moving].sum())


def share_sideways(forecast: LocalForecast, metres: float) -> float:
    """Return the share of samples that end more than ``metres`` to either side of the car's axis."""
    return float((np.abs(forecast.samples[:, -1, 1]) > metres).mean())


def share_within(forecast: LocalForecast, along: float) -> float:
    """Return the share of samples that end at most ``along`` m ahead."""
    return float((forecast.samples[:, -1, 0] <= along).mean())


def middle_along(forecast: LocalForecast, share: float) -> tuple[float, float]:
    """Return the bounds, m ahead, of the central ``share`` of the samples' ends."""
    low, high = np.quantile(forecast.samples[:, -1, 0], [(1 - share) / 2, (1 + share) / 2])
    return float(low), float(high)


def weight_ahead(forecast: LocalForecast) -> float:
    """Return the weight of the modes that end ahead of the car."""
    return float(forecast.weights[forecast.means[:, -1, 0] > 0].sum())


def last_directions(trajectories: Floats) -> Floats:
    """Return the direction of trajectories [N, T, 2] in their last second: [N], rad to the left of the
    initial heading; NaN where the car has stopped by then."""
    move = trajectories[:, -1] - trajectories[:, step(5.0)]
    angle = np.arctan2(move[:, 1], move[:, 0])
    return np.where(np.linalg.norm(move, axis=-1) >= _TURN_LEAST, angle, np.nan)


def weight_turning(forecast: LocalForecast, beyond: float, turned: float = 0.0) -> tuple[float, float]:
    """Return the weight of the modes that turn left, and right, by more than ``beyond`` rad.

    Args:
        forecast: the car's forecast.
        beyond: rad.
        turned: rad by which the car has already turned left.
    """
    angle = last_directions(forecast.means) + turned
    return float(forecast.weights[angle > beyond].sum()), float(forecast.weights[angle < -beyond].sum())


def share_turning(forecast: LocalForecast, beyond: float, turned: float = 0.0) -> tuple[float, float]:
    """Return the shares of the samples that turn left, and right, by more than ``beyond`` rad."""
    angle = last_directions(forecast.samples) + turned
    return float((angle > beyond).mean()), float((angle < -beyond).mean())


def weight_on_road(forecast: LocalForecast, raster: Raster) -> float:
    """Return the weight of the modes whose means all lie on the driveable area."""
    on_road = driveable(raster, forecast.frame.to_ground(forecast.means)).all(axis=-1)
    return float(forecast.weights[on_road].sum())


def share_on_road(forecast: LocalForecast, raster: Raster) -> float:
    """Return the share of samples that stay on the driveable area."""
    return float(driveable(raster, forecast.frame.to_ground(forecast.samples)).all(axis=-1).mean())


def share_entering(forecast: LocalForecast, lead: Frame, half_width: float = 0.0) -> float:
    """Return the share of samples that enter the box of a standing car.

    Args:
        forecast: the car's forecast.
        lead: the box's centre and heading in the forecast's frame.
        half_width: m by which the box is widened on each side, to account for the car's own width.
    """
    start = np.zeros((len(forecast.samples), 1, 2))
    knots = np.concatenate([start, forecast.samples], axis=1)
    # At 11 m/s this checks every 0.3 m
    parts = np.linspace(0, 1, 21)[:, None, None, None]
    dense = knots[:, :-1] + parts * (knots[:, 1:] - knots[:, :-1])  # [21, S, T, 2]
    beside = np.abs(lead.to_local(dense))
    inside = (beside[..., 0] < LEAD_SIZE[0] / 2) & (beside[..., 1] < LEAD_SIZE[1] / 2 + half_width)
    return float(inside.any(axis=(0, 2)).mean())


def narrow_sigma(forecast: LocalForecast, seconds: float) -> float:
    """Return the min over all moving modes of the standard deviation in its narrowest direction, m; NaN if no
    mode moves."""
    moves = np.linalg.norm(forecast.means[:, -1], axis=-1) > MOVES
    if not moves.any():
        return float("nan")
    variances = np.linalg.eigvalsh(forecast.covariances[moves, step(seconds)])
    return float(np.sqrt(variances[:, 0].clip(min=0)).min())


def likeliest_sigma(forecast: LocalForecast) -> float:
    """Return the total standard deviation (root of the trace) of the most likely mode at 6 s, m."""
    return float(np.sqrt(np.trace(forecast.covariances[forecast.weights.argmax(), -1])))


def mixture_sigma(forecast: LocalForecast) -> float:
    """Return the total standard deviation (root of the trace) of the mixture at 6 s, m."""
    covariance = forecast.mixture.moments()[1][0, -1]
    return float(covariance.trace().sqrt())


def modes_for(weights: Floats, share: float) -> int:
    """Return the number of heaviest modes that hold ``share`` of the weight."""
    return int(np.searchsorted(np.sort(weights)[::-1].cumsum(), share - 1e-9)) + 1


def merged_modes_for(forecast: LocalForecast, share: float) -> int:
    """Return the number of heaviest modes that hold ``share`` of the weight after merging."""
    return modes_for(merge_modes(forecast.mixture).mixture.weights[0].double().numpy(), share)


def apart(one: LocalForecast, other: LocalForecast) -> float:
    """Return the max distance between two forecasts, each in its own frame, over all modes (matched by id)
    and steps, m.

    Raises:
        ValueError: the forecasts do not have the same modes.
    """
    order, others = np.argsort(one.mode_ids), np.argsort(other.mode_ids)
    if not np.array_equal(one.mode_ids[order], other.mode_ids[others]):
        raise ValueError(f"modes {one.mode_ids} cannot be matched with {other.mode_ids}")
    return float(np.linalg.norm(one.means[order] - other.means[others], axis=-1).max())


def jumps(paths: Floats, interval: float) -> Floats:
    """Return the distances between the positions that successive calls forecast for the same time, 6 s after
    the earlier call: [N − 1], m. The later forecast is interpolated linearly between its steps.

    Args:
        paths: [N, T, 2], m, the most likely modes of N successive calls, ground frame.
        interval: s between the calls, less than a step.
    """
    part = 1 - interval / STEP_SECONDS
    later = (1 - part) * paths[1:, -2] + part * paths[1:, -1]
    sizes: Floats = np.linalg.norm(later - paths[:-1, -1], axis=-1)
    return sizes
