"""Augmentation by reflection: left and right exchanged, as between traffic on either side of the road."""

import torch
from torch import Tensor

from model.data.augmentation import NEIGHBORS
from model.forecaster import Features
from model.features.standardization import HEADING

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
    if "surroundings" in features:
        mirrored["surroundings"] = _flip(features["surroundings"], _BOX_SIDEWAYS, sign)
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
