"""Updates of an agent on a straight line, with forecasts that miss by a known offset."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Floats
from service.tracking.store.base import TrackUpdate
from service.tracking.store.records import BLOCK, FORECAST_BLOCKS, OBSERVATION_FIELDS

MODEL = "cab@1.0.0"
START = 1.6e9
"""s."""


def observation(time: float, position: tuple[float, float]) -> bytes:
    """Return an observation with a position only."""
    values = np.full(OBSERVATION_FIELDS, np.nan)
    values[:3] = time, *position
    return values.tobytes()


def forecast(path: Floats) -> bytes:
    """Return a forecast of one mode from its path, [T + 1, 2], m."""
    blocks = np.full(FORECAST_BLOCKS, np.nan, dtype=BLOCK)
    blocks["point"][: len(path)] = path
    return blocks.tobytes()


def where(time: float, speed: float = 10.0, off: float = 0.0) -> tuple[float, float]:
    """Return the position of the agent at a time, m."""
    return speed * (time - START), off


def track_update(
    time: float,
    agent_id: str = "a",
    *,
    model: str = MODEL,
    agent_type: bytes = b"v",
    speed: float = 10.0,
    off: float = 0.0,
    miss: float = 0.0,
    steps: int = 12,
) -> TrackUpdate:
    """Return an update: an observation and a forecast of one agent.

    Args:
        time: s.
        agent_id: its id.
        model: model of the forecast; empty: no forecast.
        agent_type: type of the agent.
        speed: m/s, along x.
        off: m, its y.
        miss: m that the forecast is beside the path, in y.
        steps: of the forecast.
    """
    path = np.array([where(time + 0.5 * k, speed, off) for k in range(steps + 1)])
    path[1:, 1] += miss
    made = forecast(path) if model else b""
    at = where(time, speed, off)
    return TrackUpdate(agent_id, agent_type, observation(time, at), model, made, steps if model else 0)


def times(count: int, step: float = 0.5, first: float = START) -> Sequence[float]:
    """Return evenly spaced times, s."""
    return [first + step * number for number in range(count)]
