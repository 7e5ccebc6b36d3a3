"""Road users of the demo scene: the lights are green from west to east, red from north to south."""

import math
from dataclasses import dataclass

import numpy as np

from cab.forecast.v1.prediction_service_pb2 import Agent
from cab_forecast.demo.crossing import LANE_WIDTH, LAY_BY_CENTER, STOP_LINE
from cab_forecast.demo.paths import Motion, Path, Segment
from cab_forecast.requests import TypeName, agent

NOW = 1_700_000_000.0
"""Seconds since the epoch."""
HISTORY_SECONDS = 2.0
OBSERVATION_RATE = 10.0
"""Hertz."""

_EAST, _NORTH, _WEST, _SOUTH = 0.0, math.pi / 2, math.pi, -math.pi / 2
_INNER, _OUTER = LANE_WIDTH / 2, LANE_WIDTH * 3 / 2
_TURN_RADIUS = 9.0


@dataclass(frozen=True)
class _RoadUser:
    agent_id: str
    agent_type: TypeName
    motion: Motion
    observed_for: float = HISTORY_SECONDS
    """Seconds."""


def traffic(now: float = NOW) -> list[Agent]:
    """Build the agents, each with a history that ends at the present.

    Args:
        now: the present, seconds since the epoch.
    """
    return [_observe(user, now) for user in _road_users()]


def _observe(user: _RoadUser, now: float) -> Agent:
    times = np.arange(-round(user.observed_for * OBSERVATION_RATE), 1) / OBSERVATION_RATE
    poses, velocities = user.motion.history(times)
    return agent(
        user.agent_id,
        user.agent_type,
        now + times,
        poses[:, :2],
        headings=poses[:, 2],
        velocities=velocities,
    )


def _road_users() -> list[_RoadUser]:
    left_turn = Path(
        _INNER - _TURN_RADIUS,
        -_INNER,
        _EAST,
        [Segment(_TURN_RADIUS * math.pi / 2, curvature=1 / _TURN_RADIUS)],
    )
    stopping = _braking(
        Path(-_INNER, 30.0, _SOUTH), stop_after=30.0 - STOP_LINE - 3.0, speed=5.0, acceleration=-2.2
    )
    return [
        _RoadUser("car-straight", "vehicle", Motion(Path(-40.0, -_OUTER, _EAST), 47.0, 10.0)),
        _RoadUser("truck-behind", "vehicle", Motion(Path(-50.0, -_OUTER, _EAST), 29.0, 8.5, 0.3)),
        _RoadUser("car-left-turn", "vehicle", Motion(left_turn, 4.5, 5.6, -0.7)),
        _RoadUser("car-braking", "vehicle", stopping),
        _RoadUser("car-parked", "vehicle", Motion(Path(*LAY_BY_CENTER, _EAST), 0.0, 0.0)),
        _RoadUser("car-oncoming", "vehicle", Motion(Path(52.0, _INNER, _WEST), 12.0, 9.0, -0.8)),
        _RoadUser("car-just-seen", "vehicle", Motion(Path(58.0, _OUTER, _WEST), 6.0, 8.0), observed_for=0.5),
        _RoadUser("cyclist", "cyclist", Motion(Path(30.0, 6.3, _WEST), 10.0, 4.8)),
        _RoadUser("walker-east", "pedestrian", Motion(Path(-10.0, -11.8, _EAST), 5.5, 1.4)),
        _RoadUser("walker-west", "pedestrian", Motion(Path(9.0, -10.4, _WEST), 4.0, 1.2)),
        _RoadUser("walker-at-kerb", "pedestrian", Motion(Path(11.0, 11.2, _WEST), 2.6, 1.1, 0.15)),
    ]


def _braking(path: Path, stop_after: float, speed: float, acceleration: float) -> Motion:
    """Return a motion that comes to a stop, with constant deceleration, at a distance along the path."""
    return Motion(path, stop_after + speed**2 / (2 * acceleration), speed, acceleration)
