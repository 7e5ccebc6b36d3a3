"""The neighbours of an agent: the nearest ones, and the edges and summed histories of Trajectron++."""

import numpy as np

from model.arrays import Floats, Ints
from model.features.standardization import ATTENTION_RADIUS, HEADING, STATE_SIZE, state_scale, state_vectors
from model.geometry import wrap_angle
from model.scenes.scene import AgentStates, AgentType

_RAMP = np.array([0.25, 0.5, 0.75, 1.0])
"""Weights of presence now, 0.5 s ago, … 1.5 s ago: an edge fades in (Trajectron++, section 4.1)."""
_PRESENCE = {AgentType.VEHICLE: 1.0, AgentType.PEDESTRIAN: 2.0}
"""Weight of a neighbour's presence; the released code multiplies by the type's number."""


def edge_ramps(
    states: AgentStates, targets: Ints, own: AgentType, neighbors: Ints, other: AgentType
) -> Floats:
    """Return the strength of the edge from each neighbour to each target: [n, m] in [0, 1], 0 for no edge.

    min(1, Σ_k f_k · a_{t−k}) over the last four frames, f = (0.25, 0.5, 0.75, 1). a is the type's presence
    while both agents are observed and the neighbour is within the attention radius. A neighbour that is not
    within it now has no edge.

    Args:
        states: states of all agents of the scene.
        targets: [n], indices of agents of type ``own``.
        own: type of the targets.
        neighbors: [m], indices of agents of type ``other``.
        other: type of the neighbours.
    """
    frames = min(len(_RAMP), states.frames)
    position = states.position[:, -frames:]
    offset = position[targets][:, None] - position[neighbors][None]
    distance = np.hypot(offset[..., 0], offset[..., 1])  # NaN where either is not observed
    with np.errstate(invalid="ignore"):
        inside = distance <= ATTENTION_RADIUS[own, other]
    inside &= (targets[:, None] != neighbors[None, :])[..., None]
    weights = _RAMP[:frames][::-1]  # the newest frame is the last
    ramp = np.minimum(1.0, _PRESENCE[other] * (inside * weights).sum(axis=-1))
    result: Floats = ramp * inside[..., -1]
    return result


def neighbor_sums(
    states: AgentStates, targets: Ints, own: AgentType, neighbors: Ints, other: AgentType, edges: Floats
) -> Floats:
    """Return the sum of the connected neighbours' standardised histories: [n, F, STATE_SIZE[other]].

    Histories are relative to the target's state now in the dimensions that both types have, headings by the
    shorter arc. What was not observed of a neighbour counts as zero after standardisation. So the sum depends
    neither on the origin of the ground frame nor, in its heading, on the direction of that frame. (The
    reference has zeros before standardisation and plain differences of headings.)

    Args:
        states: states of all agents of the scene.
        targets: [n], indices of agents of type ``own``.
        own: type of the targets.
        neighbors: [m], indices of agents of type ``other``.
        other: type of the neighbours.
        edges: [n, m], connected where > 0; the sum is not weighted by it.
    """
    size = STATE_SIZE[other]
    history = state_vectors(states, other)[neighbors]
    known = np.isfinite(history)
    connected = (edges > 0).astype(np.float64)
    common = min(size, STATE_SIZE[own])
    present = np.zeros((len(targets), 1, size))
    now = state_vectors(states.last_frames(1), own)[targets]
    present[..., :common] = np.nan_to_num(now[..., :common])

    # Σ_j c_ij (h_j − s_i), without an [n, m, F, D] array
    total = np.tensordot(connected, np.where(known, history, 0.0), axes=1)
    counted = np.tensordot(connected, known.astype(np.float64), axes=1)
    sums: Floats = total - counted * present
    if common > HEADING:  # differences of headings have to be wrapped
        difference = wrap_angle(history[None, ..., HEADING] - present[..., HEADING][:, None])
        sums[..., HEADING] = np.einsum("nm,nmf->nf", connected, np.nan_to_num(difference))
    sums /= state_scale(own, other)
    return sums
