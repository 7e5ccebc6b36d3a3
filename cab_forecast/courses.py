"""Where an agent goes, seen from itself: in its own frame, and in words that a planner uses."""

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from cab.forecast.v1.prediction_service_pb2 import Agent

_Floats = npt.NDArray[np.float64]

_STANDING_M = 0.2
"""m between two observations below which their direction is noise."""
_STAYS_M = 1.5
"""m; who gets no farther stays."""
_STOPS_M_S = 0.5
"""m/s at the end, at or below which an agent stops."""
_STRAIGHT_DEG = 10.0
_TURN_DEG = 45.0
_ROUND_DEG = 150.0
_CHANGE_M_S = 1.0
_CHANGE = 0.3
"""How much of its speed, and how many m/s at least, an agent gains or loses that speeds up or slows down."""


def heading_now(agent: Agent) -> float | None:
    """Return the last heading observed, else the direction of motion, else None: rad.

    Args:
        agent: with at least one state.
    """
    last = agent.states[-1]
    if last.HasField("heading"):
        return last.heading
    track = np.array([(state.x, state.y) for state in agent.states])
    moved = np.hypot(*(track[-1] - track).T)
    far = np.flatnonzero(moved >= _STANDING_M)
    if not len(far):
        return None
    step = track[-1] - track[far[-1]]
    return math.atan2(step[1], step[0])


def seen_from(agent: Agent, heading: float, points: _Floats) -> _Floats:
    """Return points as m ahead of the agent and m to its left, where it is and looks now: [..., 2].

    Args:
        agent: with at least one state.
        heading: rad, of ``heading_now``.
        points: [..., 2], m, ground frame.
    """
    now = agent.states[-1]
    cos, sin = math.cos(heading), math.sin(heading)
    return np.asarray((points - (now.x, now.y)) @ np.array([[cos, -sin], [sin, cos]]))


def in_words(path: _Floats, step: float) -> str:
    """Return what an agent does that takes a path: e.g. "turns left 85°, slows to 4 m/s".

    Args:
        path: [T, 2], m ahead and m to the left, from the first step on.
        step: s between two points.
    """
    whole = np.concatenate([np.zeros((1, 2)), path])
    if np.hypot(*whole.T).max() < _STAYS_M:
        return "stays"
    moves = np.diff(whole, axis=0)
    speeds = np.hypot(*moves.T) / step
    first, last = float(speeds[0]), float(speeds[-1])
    does = _direction(moves[speeds > _STOPS_M_S])
    if last <= _STOPS_M_S:
        return f"{does}, stops"
    if abs(last - first) >= max(_CHANGE_M_S, _CHANGE * first):
        return f"{does}, {'speeds up' if last > first else 'slows'} to {last:.0f} m/s"
    return does


def _direction(moves: _Floats) -> str:
    """What becomes of an agent's direction, its turns added up, on moves [M, 2] that are no standing."""
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
    if size >= _ROUND_DEG:
        return f"turns round {side}"
    return f"{'turns' if size >= _TURN_DEG else 'bears'} {side} {size:.0f}°"
