"""State vectors, and the scales that standardise them (Trajectron++, nuScenes settings).

A state vector is x, y, vx, vy, ax, ay and, for a vehicle, heading and heading rate: SI units, ground
frame.
"""

import numpy as np

from model.arrays import Floats
from model.scenes.scene import AgentStates, AgentType

STATE_SIZE = {AgentType.VEHICLE: 8, AgentType.PEDESTRIAN: 6}
"""Length of a type's state vector; other types have no network."""

HEADING = 6
"""Index of the heading in a state vector that has one."""

ATTENTION_RADIUS = {
    (AgentType.VEHICLE, AgentType.VEHICLE): 30.0,
    (AgentType.VEHICLE, AgentType.PEDESTRIAN): 20.0,
    (AgentType.PEDESTRIAN, AgentType.VEHICLE): 20.0,
    (AgentType.PEDESTRIAN, AgentType.PEDESTRIAN): 10.0,
}
"""m, radius within which an agent of the first type has neighbours of the second; also the scale of their
relative positions."""

FUTURE_POSITION_SCALE = {AgentType.VEHICLE: 80.0, AgentType.PEDESTRIAN: 1.0}
"""m, scale of future positions relative to now."""

_VELOCITY_SCALE = {AgentType.VEHICLE: 15.0, AgentType.PEDESTRIAN: 2.0}
_ACCELERATION_SCALE = {AgentType.VEHICLE: 4.0, AgentType.PEDESTRIAN: 1.0}


def state_scale(own: AgentType, of: AgentType) -> Floats:
    """Return the divisors of states of type ``of``, seen by an agent of type ``own``: [STATE_SIZE[of]]."""
    radius = ATTENTION_RADIUS[own, of]
    velocity, acceleration = _VELOCITY_SCALE[of], _ACCELERATION_SCALE[of]
    scale = [radius, radius, velocity, velocity, acceleration, acceleration, np.pi, 1.0]
    return np.array(scale[: STATE_SIZE[of]])


def state_vectors(states: AgentStates, kind: AgentType) -> Floats:
    """Return state vectors: [N, F, STATE_SIZE[kind]] float64, NaN where not observed or unknown."""
    parts = [states.position, states.velocity, states.acceleration]
    if STATE_SIZE[kind] > HEADING:
        parts += [states.heading[..., None], states.heading_rate[..., None]]
    return np.concatenate(parts, axis=-1)
