"""Trajectories in an agent's own frame, and maneuvers in words."""

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from cab.forecast.v1.prediction_service_pb2 import Agent

_Floats = npt.NDArray[np.float64]

_MIN_STEP_M = 0.2
"""Distance between two observations, m, below which their direction is noise."""
_STAYS_M = 1.5
"""Distance, m, below which an agent stays."""
_STOPS_M_S = 0.5
"""Final speed, m/s, up to which an agent stops."""
_STRAIGHT_DEG = 10.0
_TURN_DEG = 45.0
_U_TURN_DEG = 150.0
_MIN_SPEED_CHANGE_M_S = 1.0
_MIN_SPEED_CHANGE_RATIO = 0.3
"""Change relative to the initial speed from which an agent speeds up or slows down."""


def current_heading(agent: Agent) -> float | None:
    """Return the last observed heading, else the direction of motion, else None; rad.

    Args:
        agent: an agent with at least one state.
    """
    last = agent.states[-1]
    if last.HasField("heading"):
        return last.heading
    track = np.array([(state.x, state.y) for state in agent.states])
    moved = np.hypot(*(track[-1] - track).T)
    far = np.flatnonzero(moved >= _MIN_STEP_M)
    if not len(far):
        return None
    step = track[-1] - track[far[-1]]
    return math.atan2(step[1], step[0])


def to_agent_frame(agent: Agent, heading: float, points: _Floats) -> _Floats:
    """Transform points from the ground frame to an agent's: [..., 2], m ahead and m to the left.

    Args:
        agent: an agent with at least one state.
        heading: rad, from ``current_heading``.
        points: [..., 2], m, ground frame.
    """
    now = agent.states[-1]
    cos, sin = math.cos(heading), math.sin(heading)
    return np.asarray((points - (now.x, now.y)) @ np.array([[cos, -sin], [sin, cos]]))


def describe_maneuver(path: _Floats, step: float) -> str:
    """Describe the maneuver of a trajectory, e.g. "turns left 85°, slows to 4 m/s".

    Args:
        path: [T, 2], agent frame, from the first step on.
        step: seconds between two points.
    """
    whole = np.concatenate([np.zeros((1, 2)), path])
    if np.hypot(*whole.T).max() < _STAYS_M:
        return "stays"
    moves = np.diff(whole, axis=0)
    speeds = np.hypot(*moves.T) / step
    first, last = float(speeds[0]), float(speeds[-1])
    direction = _direction(moves[speeds > _STOPS_M_S])
    if last <= _STOPS_M_S:
        return f"{direction}, stops"
    if abs(last - first) >= max(_MIN_SPEED_CHANGE_M_S, _MIN_SPEED_CHANGE_RATIO * first):
        return f"{direction}, {'speeds up' if last > first else 'slows'} to {last:.0f} m/s"
    return direction


def _direction(moves: _Floats) -> str:
    """Describe the total turn over moves [M, 2] that are longer than standing still."""
    if not len(moves):
        return "creeps"
    angles = [math.atan2(left, ahead) for ahead, left in moves.tolist()]
    backwards = abs(angles[0]) > math.pi / 2
    start = math.copysign(math.pi, angles[0]) if backwards else 0.0
    turned = math.degrees(
        sum(math.remainder(after - before, 2 * math.pi) for before, after in pairwise([start, *angles]))
    )
    size = abs(turned)
    if size < _STRAIGHT_DEG:
        return "backs up" if backwards else "straight on"
    if backwards:
        return f"backs up, turning {size:.0f}°"
    side = "left" if turned > 0 else "right"
    if size >= _U_TURN_DEG:
        return f"turns round {side}"
    return f"{'turns' if size >= _TURN_DEG else 'bears'} {side} {size:.0f}°"
