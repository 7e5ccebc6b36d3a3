"""The covariance that single-trajectory baselines state.

The error of such a forecast grows with the time t ahead as

    σ²(t) = position² + (velocity · t)² + (acceleration · t² / 2)²

that is as if the position, velocity and acceleration that it goes on from were each off by an independent
error of that standard deviation. Along the direction of travel and across it the three numbers differ.

Where the numbers come from. Vehicles: 32186 (agent, time) pairs of the nuScenes prediction challenge,
split train, causal protocol (2 Hz label positions, backward differences over 0.5 s, nothing from the
future). Pedestrians: 1004 pairs with 2 s of history and 6 s of future of the eight training scenes of
nuScenes v1.0-mini, of those who had moved by at least 0.5 m within the 2 s. For each baseline, axis and
type the numbers minimise the Gaussian negative log-likelihood Σ [ln σ²(t) + e²(t) / σ²(t)] of the errors e
at t = 0.5, 1, … 6 s, all pairs and times weighing the same; a fitted 0 says that the others explain it all.

Real errors have heavier tails than a Gaussian: on the split val, the 50 % ellipses hold 66–75 % of the
vehicles' true positions and the 90 % ellipses 87–91 %.

Not fitted, assumed: cyclists and agents of unknown type get the vehicles' numbers, the widest there are.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from model.scene import AgentType


@dataclass(frozen=True)
class Growth:
    """Standard deviation of a forecast's error along one axis, as a function of time."""

    position: float
    """m."""
    velocity: float
    """m/s."""
    acceleration: float
    """m/s²."""

    def variance(self, time: Tensor) -> Tensor:
        """Variance, m², at times ahead, s; any shape."""
        return self.position**2 + (self.velocity * time) ** 2 + (self.acceleration * time**2 / 2) ** 2


@dataclass(frozen=True)
class Spread:
    """Error growth along the direction of travel and across it."""

    along: Growth
    across: Growth


def aligned_covariance(spread: Spread, time: Tensor, direction: Tensor) -> Tensor:
    """Covariances of forecasts whose errors are independent along and across a direction.

    Args:
        spread: the growth along and across.
        time: [T], s ahead.
        direction: [N, T], rad: of travel, at each time.

    Returns:
        [N, T, 2, 2], m², symmetric and positive definite.
    """
    return oriented_covariance(spread.along.variance(time), spread.across.variance(time), direction)


def oriented_covariance(along: Tensor, across: Tensor, direction: Tensor) -> Tensor:
    """Covariances of what is independent along and across a direction.

    Args:
        along: [T], m², variance along it.
        across: [T], m², across it.
        direction: [N, T], rad.

    Returns:
        [N, T, 2, 2], m², symmetric.
    """
    cos, sin = torch.cos(direction), torch.sin(direction)
    xx = along * cos.square() + across * sin.square()
    yy = along * sin.square() + across * cos.square()
    xy = (along - across) * cos * sin
    return torch.stack([torch.stack([xx, xy], dim=-1), torch.stack([xy, yy], dim=-1)], dim=-2)


def ellipse_radius(probability: float) -> float:
    """How many standard deviations the ellipse reaches that holds this share of a 2-D Gaussian.

    Args:
        probability: in [0, 1).
    """
    return math.sqrt(-2 * math.log1p(-probability))


def for_every_type(vehicle: Spread, pedestrian: Spread) -> Mapping[AgentType, Spread]:
    """A spread for every type from the two that were fitted; the rest is the module's assumption."""
    return {
        AgentType.VEHICLE: vehicle,
        AgentType.PEDESTRIAN: pedestrian,
        AgentType.CYCLIST: vehicle,
        AgentType.UNKNOWN: vehicle,
    }


CONSTANT_VELOCITY_YAW = for_every_type(
    vehicle=Spread(along=Growth(0.0, 0.907, 0.647), across=Growth(0.0, 0.321, 0.476)),
    pedestrian=Spread(along=Growth(0.046, 0.173, 0.060), across=Growth(0.0, 0.161, 0.071)),
)
CONSTANT_SPEED_YAW_RATE = for_every_type(
    vehicle=Spread(along=Growth(0.0, 0.901, 0.663), across=Growth(0.089, 0.135, 0.385)),
    pedestrian=Spread(along=Growth(0.054, 0.162, 0.082), across=Growth(0.027, 0.136, 0.064)),
)
CONSTANT_ACCELERATION_YAW = for_every_type(
    vehicle=Spread(along=Growth(0.0, 1.081, 1.591), across=Growth(0.0, 0.321, 0.482)),
    pedestrian=Spread(along=Growth(0.0, 0.255, 0.366), across=Growth(0.0, 0.162, 0.088)),
)
CONSTANT_ACCELERATION_YAW_RATE = for_every_type(
    vehicle=Spread(along=Growth(0.0, 1.080, 1.587), across=Growth(0.088, 0.139, 0.393)),
    pedestrian=Spread(along=Growth(0.0, 0.254, 0.360), across=Growth(0.027, 0.138, 0.089)),
)
