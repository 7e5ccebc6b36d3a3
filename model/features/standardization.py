"""States as vectors, and the scales that bring them near one (Trajectron++, nuScenes settings).

A state vector is x, y, vx, vy, ax, ay and, for a vehicle, heading and heading rate: SI units, ground
frame.
"""

import numpy as np

from model.arrays import Floats
from model.scenes.scene import AgentStates, AgentType

STATE_SIZE = {AgentType.VEHICLE: 8, AgentType.PEDESTRIAN: 6}
"""Length of a type's state vector; types that are not here have no network."""

HEADING = 6
"""Where a state vector has its heading, if it has one."""

ATTENTION_RADIUS = {
    (AgentType.VEHICLE, AgentType.VEHICLE): 30.0,
    (AgentType.VEHICLE, AgentType.PEDESTRIAN): 20.0,
    (AgentType.PEDESTRIAN, AgentType.VEHICLE): 20.0,
    (AgentType.PEDESTRIAN, AgentType.PEDESTRIAN): 10.0,
}
"""m, how far an agent of the first type looks for neighbours of the second; also the scale of their
relative positions."""

FUTURE_POSITION_SCALE = {AgentType.VEHICLE: 80.0, AgentType.PEDESTRIAN: 1.0}
"""m, scale of future positions relative to now."""

_VELOCITY_SCALE = {AgentType.VEHICLE: 15.0, AgentType.PEDESTRIAN: 2.0}
_ACCELERATION_SCALE = {AgentType.VEHICLE: 4.0, AgentType.PEDESTRIAN: 1.0}


def state_scale(own: AgentType, of: AgentType) -> Floats:
    """[STATE_SIZE[of]], what states of type ``of`` are divided by when an agent of type ``own`` looks."""
    radius = ATTENTION_RADIUS[own, of]
    velocity, acceleration = _VELOCITY_SCALE[of], _ACCELERATION_SCALE[of]
    scale = [radius, radius, velocity, velocity, acceleration, acceleration, np.pi, 1.0]
    return np.array(scale[: STATE_SIZE[of]])


def state_vectors(states: AgentStates, kind: AgentType) -> Floats:
    """[N, F, STATE_SIZE[kind]] float64, NaN where not observed (and for a heading that is unknown)."""
    parts = [states.position, states.velocity, states.acceleration]
    if STATE_SIZE[kind] > HEADING:
        parts += [states.heading[..., None], states.heading_rate[..., None]]
    return np.concatenate(parts, axis=-1)
