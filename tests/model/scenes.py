"""Scenes for the tests of forecasters."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Floats
from model.scene import AgentStates, AgentType, Scene


def present(
    *,
    position: ArrayLike = (0.0, 0.0),
    velocity: ArrayLike = (0.0, 0.0),
    acceleration: ArrayLike = (0.0, 0.0),
    heading: ArrayLike = np.nan,
    heading_rate: ArrayLike = 0.0,
    kind: AgentType = AgentType.VEHICLE,
) -> Scene:
    """A scene of one agent that is seen only now."""
    states = AgentStates(
        position=_agent(position),
        velocity=_agent(velocity),
        acceleration=_agent(acceleration),
        heading=_agent(heading),
        heading_rate=_agent(heading_rate),
        first=np.zeros(1, dtype=np.int64),
        velocity_known=np.ones(1, dtype=np.bool_),
    )
    return Scene([kind], states)


def tracks(positions: Sequence[ArrayLike], frames: int, kind: AgentType = AgentType.VEHICLE) -> Scene:
    """A scene of agents along positions [n, 2] (n frames up to now, at most ``frames``), velocity by
    differences, the rest zero."""
    count = len(positions)
    position = np.full((count, frames, 2), np.nan)
    velocity = np.full((count, frames, 2), np.nan)
    first = np.zeros(count, dtype=np.int64)
    for n, path in enumerate(positions):
        array = np.asarray(path, dtype=np.float64)
        first[n] = frames - len(array)
        position[n, first[n] :] = array
        velocity[n, first[n] :] = np.diff(array, axis=0, prepend=array[:1]) / 0.5
    zeros = np.where(np.isnan(position), np.nan, 0.0)
    heading = np.full((count, frames), np.nan)
    return Scene(
        [kind] * count,
        AgentStates(position, velocity, zeros, heading, zeros[..., 0], first, first < position.shape[1]),
    )


def _agent(values: ArrayLike) -> Floats:
    """[1, 1, ...]"""
    return np.asarray(values, dtype=np.float64)[None, None]
