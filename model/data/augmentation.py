"""Augmentation by rotation: each agent's surroundings turned about its position now."""

import math

import torch
from torch import Tensor

from model.features.standardization import HEADING
from model.forecaster import Features

NEIGHBORS = "neighbors."
"""Features whose names begin so are states of neighbours."""


def rotate(features: Features, future: Tensor, angle: Tensor) -> tuple[Features, Tensor]:
    """Features as they were had each scene been turned about its agent.

    ``origin`` stays, and so does the map patch, which lies in the agent's frame. Of standardised states it
    takes that x and y have the same scale.

    Args:
        features: of n vehicles, from ``scene_features`` or ``Batches``; left as they are.
        future: [n, T, 2], relative to the position now.
        angle: [n], rad, counter-clockwise.

    Returns:
        New features, and the new future.
    """
    turned = dict(features)
    matrix = _matrices(angle)
    history = _turn_states(features["history"], matrix)
    # Headings are fractions of π. The present one stays in [-1, 1) and the others run on from it; what was
    # not observed stays zero
    now = history[:, -1:, HEADING]
    shift = torch.remainder(now + (angle / math.pi).to(now.dtype)[:, None] + 1, 2) - 1 - now
    frames = torch.arange(history.shape[1], device=history.device)
    history[..., HEADING] += torch.where(frames >= features["first"][:, None], shift, 0.0)
    turned["history"] = history
    turned["velocity"] = _turn(features["velocity"], matrix)
    for name, states in features.items():
        if name.startswith(NEIGHBORS):  # their headings are relative to the own
            turned[name] = _turn_states(states, matrix)
    return turned, _turn(future, matrix)


def _matrices(angle: Tensor) -> Tensor:
    """[n, 2, 2], for row vectors: v @ R."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    return torch.stack([torch.stack([cos, sin], dim=-1), torch.stack([-sin, cos], dim=-1)], dim=-2)


def _turn(vectors: Tensor, matrix: Tensor) -> Tensor:
    """Vectors [n, …, 2]."""
    flat = vectors.reshape(len(vectors), -1, 2)
    return torch.bmm(flat, matrix.to(vectors.dtype)).view(vectors.shape)


def _turn_states(states: Tensor, matrix: Tensor) -> Tensor:
    """State vectors [n, F, D]: positions, velocities and accelerations turned, the rest copied."""
    vectors = states[..., :HEADING]
    return torch.cat([_turn(vectors, matrix), states[..., HEADING:]], dim=-1)


_SIDEWAYS = (1, 3, 5, HEADING, HEADING + 1)
"""Of a state: y, its velocity and acceleration; of a vehicle also heading and heading rate."""
_BOX_SIDEWAYS = (1, 2)
"""Of a box: left of the agent, heading."""
_NEIGHBOR_SIDEWAYS = (1, 3, 5, 7)
"""Of a neighbour in the agent's frame: y, sine of the heading, velocity and acceleration along y."""
_MAPS = ("map", "far_map")


def mirror(features: Features, future: Tensor, chosen: Tensor) -> tuple[Features, Tensor]:
    """Features as they were had the scenes of some agents been reflected, y for −y.

    The map patch, which lies in the agent's frame, has its columns exchanged about that of the agent; the
    first, to the far right, for which there is none on the left, repeats the one beside it.

    Args:
        features: of n vehicles, from ``network_features`` or ``Batches``; left as they are.
        future: [n, T, 2], relative to the position now.
        chosen: [n] bool, which of them.

    Returns:
        New features, and the new future.
    """
    sign = torch.where(chosen, -1.0, 1.0)
    mirrored = dict(features)
    for name, values in features.items():
        if name in {"history", "velocity"} or name.startswith(NEIGHBORS):
            mirrored[name] = _flip(values, _SIDEWAYS, sign)
    if "neighbor_boxes" in features:
        mirrored["neighbor_boxes"] = _flip(features["neighbor_boxes"], _BOX_SIDEWAYS, sign)
    if "neighbors" in features:
        mirrored["neighbors"] = _flip(features["neighbors"], _NEIGHBOR_SIDEWAYS, sign)
    if "heading" in features:
        mirrored["heading"] = features["heading"] * sign.to(features["heading"].dtype)
    rows = chosen.nonzero()[:, 0]
    for name in features.keys() & set(_MAPS):
        turned = features[name][rows].flip(-1)
        mirrored[name] = features[name].clone()
        mirrored[name][rows] = torch.cat([turned[..., :1], turned[..., :-1]], dim=-1)
    return mirrored, _flip(future, _SIDEWAYS, sign)


def _flip(values: Tensor, columns: tuple[int, ...], sign: Tensor) -> Tensor:
    """[n, …, D], those of the columns that there are times each agent's sign."""
    there = [column for column in columns if column < values.shape[-1]]
    flipped = values.clone()
    flipped[..., there] *= sign.to(values.dtype).view(-1, *[1] * (values.dim() - 1))
    return flipped
