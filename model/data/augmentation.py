"""Augmentation by symmetry: scenes rotated or mirrored, which are scenes that could as well have happened.

``rotate`` and ``mirror`` transform features as if the scene had been transformed before they were made.
Changes that are no symmetries (noise, missing context, other sizes) are in ``model.data.perturbation``.
"""

import math
from typing import Final

import torch
from torch import Tensor

from model.features.standardization import HEADING
from model.forecaster import Features

NEIGHBORS: Final = "neighbors."
"""Prefix of the names of features that are states of neighbours in the ground frame."""

_LATERAL: Final = (1, 3, 5, HEADING, HEADING + 1)
"""Columns of a state that change sign in a mirror: y, its velocity and acceleration; of a vehicle also
heading and heading rate."""
_BOX_LATERAL: Final = (1, 2)
"""Such columns of a box: distance to the left of the agent, heading."""
_NEIGHBOR_LATERAL: Final = (1, 3, 5, 7)
"""Such columns of a neighbour in the agent's frame: y, sine of the heading, velocity and acceleration along
y."""
_MAPS: Final = ("map", "far_map")


def rotate(features: Features, future: Tensor, angle: Tensor) -> tuple[Features, Tensor]:
    """Return features and futures of scenes that are rotated, each about its agent.

    ``origin`` stays, and so does the map patch, which lies in the agent's frame. Standardised states are
    assumed to have the same scale along x and y.

    Args:
        features: features of n vehicles, from ``scene_features`` or ``Batches``; not modified.
        future: [n, T, 2], relative to the position now.
        angle: [n], rad, counter-clockwise.

    Returns:
        New features, and the new future.
    """
    rotated = dict(features)
    matrix = _matrices(angle)
    history = _rotate_states(features["history"], matrix)
    # Headings are fractions of π. The present one stays in [-1, 1) and the others run on from it; what was
    # not observed stays zero
    now = history[:, -1:, HEADING]
    shift = torch.remainder(now + (angle / math.pi).to(now.dtype)[:, None] + 1, 2) - 1 - now
    frames = torch.arange(history.shape[1], device=history.device)
    history[..., HEADING] += torch.where(frames >= features["first"][:, None], shift, 0.0)
    rotated["history"] = history
    rotated["velocity"] = _rotate_vectors(features["velocity"], matrix)
    for name, states in features.items():
        if name.startswith(NEIGHBORS):  # their headings are relative to the agent's
            rotated[name] = _rotate_states(states, matrix)
    return rotated, _rotate_vectors(future, matrix)


def mirror(features: Features, future: Tensor, chosen: Tensor) -> tuple[Features, Tensor]:
    """Return features and futures in which the scenes of some agents are mirrored, y for −y.

    The columns of a map patch, which lies in the agent's frame, are exchanged about that of the agent. The
    first one, to the far right, has no counterpart on the left and repeats its neighbour.

    Args:
        features: features of n vehicles, from ``network_features`` or ``Batches``; not modified.
        future: [n, T, 2], relative to the position now.
        chosen: [n] bool, which scenes are mirrored.

    Returns:
        New features, and the new future.
    """
    sign = torch.where(chosen, -1.0, 1.0)
    mirrored = dict(features)
    for name, values in features.items():
        if name in {"history", "velocity"} or name.startswith(NEIGHBORS):
            mirrored[name] = _flip(values, _LATERAL, sign)
    if "neighbor_boxes" in features:
        mirrored["neighbor_boxes"] = _flip(features["neighbor_boxes"], _BOX_LATERAL, sign)
    if "neighbors" in features:
        mirrored["neighbors"] = _flip(features["neighbors"], _NEIGHBOR_LATERAL, sign)
    if "heading" in features:
        mirrored["heading"] = features["heading"] * sign.to(features["heading"].dtype)
    rows = chosen.nonzero()[:, 0]
    for name in features.keys() & set(_MAPS):
        flipped = features[name][rows].flip(-1)
        mirrored[name] = features[name].clone()
        mirrored[name][rows] = torch.cat([flipped[..., :1], flipped[..., :-1]], dim=-1)
    return mirrored, _flip(future, _LATERAL, sign)


def _matrices(angle: Tensor) -> Tensor:
    """Return rotation matrices R for row vectors, v @ R: [n, 2, 2]."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    return torch.stack([torch.stack([cos, sin], dim=-1), torch.stack([-sin, cos], dim=-1)], dim=-2)


def _rotate_vectors(vectors: Tensor, matrix: Tensor) -> Tensor:
    """Return rotated vectors [n, …, 2]."""
    flat = vectors.reshape(len(vectors), -1, 2)
    return torch.bmm(flat, matrix.to(vectors.dtype)).view(vectors.shape)


def _rotate_states(states: Tensor, matrix: Tensor) -> Tensor:
    """Return states [n, F, D] with positions, velocities and accelerations rotated, the rest copied."""
    vectors = states[..., :HEADING]
    return torch.cat([_rotate_vectors(vectors, matrix), states[..., HEADING:]], dim=-1)


def _flip(values: Tensor, columns: tuple[int, ...], sign: Tensor) -> Tensor:
    """Return values [n, …, D] whose given columns, as far as there are such, have each agent's sign."""
    there = [column for column in columns if column < values.shape[-1]]
    flipped = values.clone()
    flipped[..., there] *= sign.to(values.dtype).view(-1, *[1] * (values.dim() - 1))
    return flipped
